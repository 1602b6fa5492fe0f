"""Limits of a workshop on a shape, as smooth slacks that are positive where a limit is met."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.design.polygons import edges, rotated, turns
from optshape_graph.design.symmetry import nearest_self_rotation
from optshape_graph.errors import InputError

SHEETS = {"A0": (0.841, 1.189), "A1": (0.594, 0.841), "A2": (0.420, 0.594), "A3": (0.297, 0.420), "A4": (0.210, 0.297)}
"""Paper formats, metres (ISO 216)."""

_TURNS = 360
"""Orientations in a turn at which a shape is compared with itself, and laid on a sheet."""


@dataclass(frozen=True)
class Limits:
    """Bounds on a target of a given area; None: not bounded.

    Attributes:
        area: square metres.
        shortest_edge: metres.
        smallest_angle: of two neighbouring edges, rad.
        aspect: largest ratio of the diameter to the smallest width.
        asymmetry: smallest share of its area that the shape uncovers under any rotation that is not slight
            (`nearest_self_rotation`). The score itself allows symmetry: among triangles the equilateral one is best.
        sheet: sides of a sheet on which the target fits in some orientation, metres.

    Raises:
        InputError: a bound that is not positive.
    """

    area: float = 1.0
    shortest_edge: float | None = 0.4
    smallest_angle: float | None = None
    aspect: float | None = None
    asymmetry: float | None = 0.12
    sheet: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not (np.isfinite(value).all() and np.min(value) > 0):
                raise InputError(f"{field.name}: expected a positive number; found {value}")

    def slacks(self, polygons: Floats) -> Floats:
        """(B, c) slacks of (B, n, 2) polygons of unit area, relative to the bound: all >= 0 if the limits are met."""
        scaled = polygons * np.sqrt(self.area)
        lengths = np.linalg.norm(edges(scaled), axis=-1)
        slacks = [np.empty((len(scaled), 0))]
        if self.shortest_edge is not None:
            slacks.append(lengths / self.shortest_edge - 1.0)
        if self.smallest_angle is not None:
            slacks.append((np.pi - turns(scaled)) / self.smallest_angle - 1.0)
        if self.aspect is not None:
            slacks.append(self.aspect * widths(scaled) / diameters(scaled)[:, None] - 1.0)
        if self.asymmetry is not None:
            found = [nearest_self_rotation(polygon, _TURNS).distance for polygon in scaled]
            slacks.append(np.array(found)[:, None] / self.asymmetry - 1.0)
        if self.sheet is not None:
            extents = np.ptp(rotated(scaled, np.pi * np.arange(_TURNS // 2) / (_TURNS // 2)), axis=-2)
            slacks.append(1.0 - (extents / np.array(self.sheet)).max(axis=-1).min(axis=-1, keepdims=True))
        return np.concatenate(slacks, axis=-1)


def diameters(polygons: Floats) -> Floats:
    """Return the largest distances (...,) between two vertices, in the unit of the polygons (..., n, 2)."""
    apart = polygons[..., :, None, :] - polygons[..., None, :, :]
    return np.asarray(np.linalg.norm(apart, axis=-1).max(axis=(-2, -1)))


def widths(polygons: Floats) -> Floats:
    """Return the extents (..., n) across each edge, in the unit of the polygons (..., n, 2).

    The smallest extent of a convex polygon is its width.
    """
    along = edges(polygons)
    normals = np.stack([-along[..., 1], along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)
    return np.asarray(np.ptp(polygons @ np.swapaxes(normals, -1, -2), axis=-2))
