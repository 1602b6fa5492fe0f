"""Patterns that are printed on a target for cameras, as black areas of the drawing, mm, as the camera sees them.

A target with a chessboard and with tags on its white squares is a ChArUco board: both are drawn.
"""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.design.polylines import MM, Layer, Polyline
from optshape_graph.errors import InputError
from optshape_graph.io.image_files import tag_cells
from optshape_graph.target import Chessboard, Tags, Target


def pattern_of(target: Target) -> list[Polyline]:
    """Return the black areas of the patterns on a target; none without a pattern.

    Raises:
        InputError: the pattern reaches beyond the outline.
        MissingExtraError: OpenCV, which has the tags, is absent.
    """
    areas = []
    if target.chessboard is not None:
        areas += _squares(target.chessboard, target.tags)
    if target.tags is not None:
        areas += [area for number in target.tags.centres for area in _tag(target.tags, number)]
    for area in areas:
        beyond = float(target.outside_distance(area.points / np.array([-MM, MM])).max())
        if beyond > 0:
            raise InputError(
                f"target '{target.name}': {area.name} reaches {1000 * beyond:.0f} mm beyond the outline; "
                "expected the pattern on the target"
            )
    return areas


def _squares(board: Chessboard, tags: Tags | None) -> list[Polyline]:
    """Return the black squares: those without tags or, if there are no tags, the one at the top left and its like."""
    n_z, n_y = board.inner_corners
    rows, columns = np.indices((n_z + 1, n_y + 1))
    # Row 0 is the lowest; column 0 has the least y, and is at the right as the LiDAR sees it.
    low_y = (columns - (n_y + 1) / 2) * board.square + board.offset[0]
    low_z = (rows - (n_z + 1) / 2) * board.square + board.offset[1]
    parity = (rows + columns) % 2
    black = parity[n_z, n_y]
    if tags is not None:
        first = np.array(next(iter(tags.centres.values())))
        inside = (np.abs(low_y + board.square / 2 - first[0]) < board.square / 2) & (
            np.abs(low_z + board.square / 2 - first[1]) < board.square / 2
        )
        black = 1 - parity[inside][0] if inside.any() else black
    areas = []
    corners = board.square * np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]])
    for y, z in zip(low_y[parity == black], low_z[parity == black], strict=True):
        areas.append(_area(corners + np.array([y, z]), "chessboard"))
    return areas


def _tag(tags: Tags, number: int) -> list[Polyline]:
    """Return the black cells of one tag, neighbours in a row joined."""
    white = tag_cells(tags.dictionary, number)
    cells = len(white)
    corners = tags.corners(number)  # top left, top right, bottom right, bottom left, as the viewer sees them
    right, down = (corners[1] - corners[0]) / cells, (corners[3] - corners[0]) / cells
    areas = []
    for row in range(cells):
        changes = np.flatnonzero(np.diff(np.concatenate([[1], white[row], [1]])))
        for start, end in changes.reshape(-1, 2):
            steps = np.array([[start, row], [end, row], [end, row + 1], [start, row + 1]], dtype=float)
            areas.append(_area(corners[0] + steps @ np.array([right, down]), f"tag-{number}"))
    return areas


def _area(yz: Floats, name: str) -> Polyline:
    return Polyline(yz * np.array([-MM, MM]), Layer.PRINT, closed=True, name=name, filled=True)
