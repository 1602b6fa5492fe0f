"""A target as built: its outline is fitted to measured lengths, and its pattern scaled like the print."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.target import Target

RULER = 0.5e-3
"""Standard deviation of a measured length, metres."""

CUT = 5e-3
"""Standard deviation of a vertex about its drawn place, metres, for what the lengths do not determine."""

LARGEST_MISFIT = 5e-3
"""A length is taken for a mistake if it differs by more from that of the fitted outline, metres."""

LARGEST_SCALE_ERROR = 0.1
"""A print scale that differs by more from 1 is taken for a mistake."""


def as_measured(target: Target, lengths: Mapping[tuple[int, int], float], print_scale: float = 1.0) -> Target:
    """Return the target with the outline that fits measured lengths.

    Args:
        target: as it was drawn.
        lengths: distances of vertices, metres, by their numbers (i, j): sides and diagonals. Sides alone let a
            quadrilateral shear; it then stays as near to the drawing as they allow.
        print_scale: measured length of a printed line over its length on the drawing.

    Raises:
        InputError: an unknown vertex, a length that is not positive, lengths that fit no outline near the drawn one, or
            a print scale that is not near 1.
    """
    if not abs(print_scale - 1.0) <= LARGEST_SCALE_ERROR:
        raise InputError(f"print scale {print_scale:.4g}: expected measured over drawn length, within 10 % of 1")
    n = len(target)
    for (i, j), length in lengths.items():
        if not (0 <= i < n and 0 <= j < n and i != j):
            raise InputError(f"length {i}-{j}: expected two of the vertices 0 to {n - 1}")
        if not (np.isfinite(length) and length > 0):
            raise InputError(f"length {i}-{j}: expected a positive number; found {length}")
    drawn = target.polygon
    pairs = np.array(list(lengths), dtype=int).reshape(-1, 2)
    measured = np.array(list(lengths.values()), dtype=float)

    def misfits(vertices: Floats) -> Floats:
        polygon = vertices.reshape(n, 2)
        found = np.linalg.norm(polygon[pairs[:, 0]] - polygon[pairs[:, 1]], axis=1)
        return np.concatenate([(found - measured) / RULER, (vertices - drawn.ravel()) / CUT])

    polygon = least_squares(misfits, drawn.ravel()).x.reshape(n, 2)
    left = np.abs(misfits(polygon.ravel())[: len(pairs)]) * RULER
    if len(pairs) and left.max() > LARGEST_MISFIT:
        worst = int(left.argmax())
        i, j = pairs[worst]
        drawn_length = float(np.linalg.norm(drawn[i] - drawn[j]))
        raise InputError(
            f"length {i}-{j}: {1000 * measured[worst]:.1f} mm fits no outline near the drawn one, where it is "
            f"{1000 * drawn_length:.1f} mm; measure it again"
        )
    # The frame follows the outline: its origin is the vertex mean, and the print keeps its place on the plate.
    shift = polygon.mean(axis=0)
    outline = Target.from_polygon(polygon, target.name)
    board, tags = target.chessboard, target.tags
    if board is not None:
        y, z = print_scale * np.array(board.offset) - shift
        board = replace(board, square=board.square * print_scale, offset=(float(y), float(z)))
    if tags is not None:
        moved = {number: print_scale * np.array(centre) - shift for number, centre in tags.centres.items()}
        centres = {number: (float(y), float(z)) for number, (y, z) in moved.items()}
        tags = replace(tags, size=tags.size * print_scale, centres=centres)
    return replace(outline, chessboard=board, tags=tags)
