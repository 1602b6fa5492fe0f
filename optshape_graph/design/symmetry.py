"""The similarity of a shape to turned copies of itself, which makes poses ambiguous."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from optshape_graph._arrays import Floats
from optshape_graph.design.polygons import centred, edges

STEPS = 1440
"""Angles in a turn at which a shape is compared with itself, a quarter of a degree apart."""


@dataclass(frozen=True)
class SelfRotation:
    """The rotation, other than a slight one, under which a shape covers itself best.

    Attributes:
        angle: of the rotation about the area's centroid, rad.
        distance: area that the shape covers and its copy does not, over the area of the shape: 0 for a symmetric shape.
    """

    angle: float
    distance: float


def nearest_self_rotation(polygon: Floats, steps: int = STEPS) -> SelfRotation:
    """Find the rotation under which a convex polygon (n, 2) is most like itself.

    Slight rotations do not count: those up to the angle at which the distance, rising from 0, first falls again.
    """
    distances = self_distances(polygon, steps)
    start = int((np.diff(distances) < 0).argmax())  # the first local maximum
    best = start + int(distances[start:].argmin())
    return SelfRotation(2 * np.pi * best / steps, float(distances[best]))


def self_distances(polygon: Floats, steps: int = STEPS) -> Floats:
    """Return the relative area that a convex polygon (n, 2) uncovers when it is turned.

    Returns:
        (K,), K = steps / 2 + 2, for rotations by multiples of a turn / steps, from none to just over half a turn. A
        rotation by -angle uncovers as much as one by angle.
    """
    squares = radii(centred(polygon), steps) ** 2
    turned = sliding_window_view(np.tile(squares, 2), steps)[: steps // 2 + 2]
    # The area between two outlines about one centre is half the integral of |r^2 - r'^2| over the directions; half of
    # it is in the first outline and not in the second.
    return np.asarray(0.5 * np.abs(squares - turned).sum(axis=1) / squares.sum())


def radii(polygon: Floats, steps: int = STEPS) -> Floats:
    """Return distances (steps,) from the origin, inside, to the outline of a convex polygon (n, 2), in its unit."""
    angles = 2 * np.pi * np.arange(steps) / steps
    along = edges(polygon)
    normals = np.column_stack([along[:, 1], -along[:, 0]])
    offsets = (normals * polygon).sum(axis=1)
    facing = np.column_stack([np.cos(angles), np.sin(angles)]) @ normals.T
    return np.asarray(1.0 / (facing / offsets).max(axis=1))
