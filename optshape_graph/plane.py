"""The plane of the returns of a planar target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.errors import EstimationError
from optshape_graph.groups import Groups
from optshape_graph.se3 import cross, transform

NEAREST_M = 0.02
"""A plane that is nearer, metres, passes through the sensor's own housing."""


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
    """Fit a plane to one target's returns; see `fit_planes`.

    Args:
        points: (N, 3) metres, LiDAR frame.
        ring: (N,) or None.

    Raises:
        EstimationError: the returns do not span a plane, or the plane passes through the sensor.
    """
    if len(points) == 0:
        raise EstimationError("no returns; a plane takes three at least")
    weights: Floats = np.ones(len(points))
    if ring is not None:
        weights = np.asarray((1.0 / (1.0 + np.bincount(ring)))[ring])
    (plane,) = fit_planes(points, weights, Groups.of([points]))
    if isinstance(plane, EstimationError):
        raise plane
    return plane


def fit_planes(points: Floats, weights: Floats, scans: Groups) -> list[ReturnsPlane | EstimationError]:
    """Fit a plane to each target's returns, with a weight for each ring that grows with its returns up to a limit.

    A ring's range bias does not average away, so a ring never counts for more than a few of its returns.

    Args:
        points: (N, 3) metres, LiDAR frame.
        weights: (N,) numbers: 1 / (1 + n) of a ring with n returns; 1 without rings.
        scans: the returns of each of B targets.

    Returns:
        For each target its plane; or the error, where the returns span none, or one that passes through the sensor.
    """
    weights = weights / scans.each(scans.sum(weights))
    centres = scans.sum(weights[:, None] * points)
    centred = (points - scans.each(centres)) * np.sqrt(weights)[:, None]
    values, vectors = np.linalg.eigh(scans.products(centred, centred))
    spread, normals = np.sqrt(np.maximum(values[:, 1], 0.0)), vectors[:, :, 0]
    distance = (normals * centres).sum(axis=1)
    edge_on = np.abs(distance) < np.maximum(1e-2 * np.linalg.norm(centres, axis=1), NEAREST_M)
    axes = _axes(normals * np.sign(distance)[:, None], centres)
    found: list[ReturnsPlane | EstimationError] = []
    for k, n in enumerate(scans.counts.tolist()):
        if n < 3:
            found.append(EstimationError(f"{n} different returns; a plane takes three at least"))
        elif spread[k] < 1e-3:
            found.append(EstimationError(f"{n} returns lie on a line (they spread {spread[k] * 1e3:.2g} mm beside it)"))
        elif edge_on[k]:
            found.append(EstimationError("the plane of the returns passes through the sensor: it is seen edge-on"))
        else:
            found.append(ReturnsPlane(axes[k], centres[k]))
    return found


def _axes(normals: Floats, centres: Floats) -> Floats:
    """(B, 3, 3) axes of planes like a target's, seen from the sensor, by normals and centres (B, 3)."""
    turning = np.column_stack([-centres[:, 1], centres[:, 0], np.zeros(len(centres))])
    with np.errstate(all="ignore"):  # a plane that is seen edge-on has no such axes
        left = turning - centres * ((turning * normals).sum(axis=1) / (normals * centres).sum(axis=1))[:, None]
        left -= normals * (left * normals).sum(axis=1, keepdims=True)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([normals, left, cross(normals, left)], axis=1)
