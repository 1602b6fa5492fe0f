"""The plane of the returns of a planar target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.errors import EstimationError
from optshape_graph.se3 import transform


@dataclass(frozen=True, eq=False, repr=False)
class ReturnsPlane(Value):
    """The plane of the returns, with axes like the target's: away from the sensor, left, up.

    Attributes:
        axes: (3, 3) rows: the plane's unit normal pointing away from the sensor, the direction in the plane in
            which azimuth grows, and the one in which elevation grows. LiDAR frame.
        centre: (3,) a point of the plane, metres, LiDAR frame.
    """

    axes: Floats
    centre: Floats

    @property
    def distance(self) -> float:
        """Distance from the sensor along the normal, metres."""
        return float(self.axes[0] @ self.centre)

    def poses(self, angle: Floats, t: Floats) -> Floats:
        """Return T_target_lidar (C, 4, 4) of targets in this plane.

        Args:
            angle: (C,) turn in the plane, rad.
            t: (C, 2) place of `centre` in the target's (y, z), metres.
        """
        c, s = np.cos(angle), np.sin(angle)
        turn = np.zeros((len(angle), 3, 3))
        turn[:, 0, 0] = 1.0
        turn[:, 1, 1] = turn[:, 2, 2] = c
        turn[:, 1, 2], turn[:, 2, 1] = -s, s
        R = turn @ self.axes
        return transform(R, np.column_stack([np.zeros(len(t)), t]) - R @ self.centre)


def fit_plane(points: Floats, ring: Ints | None) -> ReturnsPlane:
    """Fit a plane to a target's returns, with a weight for each ring that grows with its returns up to a limit.

    A ring's range bias does not average away, so a ring never counts for more than a few of its returns.

    Args:
        points: (N, 3) metres, LiDAR frame.
        ring: (N,) or None.

    Raises:
        EstimationError: the returns do not span a plane, or the plane passes through the sensor.
    """
    if len(points) < 3:
        raise EstimationError(f"{len(points)} returns do not span a plane")
    weights: Floats = np.ones(len(points))
    if ring is not None:
        _, inverse, counts = np.unique(ring, return_inverse=True, return_counts=True)
        weights = np.asarray((1.0 / (1.0 + counts))[inverse])
    weights /= weights.sum()
    centre = weights @ points
    centred = (points - centre) * np.sqrt(weights)[:, None]
    _, spreads, directions = np.linalg.svd(centred, full_matrices=False)
    if spreads[1] < 1e-3:
        raise EstimationError(f"{len(points)} returns lie on a line (they spread {spreads[1] * 1e3:.2g} mm beside it)")
    normal = directions[2]
    distance = float(normal @ centre)
    if abs(distance) < 1e-2 * float(np.linalg.norm(centre)):
        raise EstimationError("the plane of the returns passes through the sensor: it is seen edge-on")
    normal = normal * np.sign(distance)
    turning = np.array([-centre[1], centre[0], 0.0])
    left = turning - centre * (turning @ normal) / (normal @ centre)
    left -= normal * (left @ normal)
    left /= np.linalg.norm(left)
    return ReturnsPlane(np.array([normal, left, np.cross(normal, left)]), centre)
