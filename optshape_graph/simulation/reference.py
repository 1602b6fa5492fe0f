"""The setting of the paper's simulations, with the quirks of its simulator.

That simulator hangs a VLP-32C upside down, and fires every ray from the origin through a point at 150 m whose z it
raises by 1 cm per ring, at azimuths k 0.4 deg. It places the target by the crossing of its diagonals, not by its vertex
mean. Here this is a sensor table and a pose; rays and target are as always.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.io.sensors import load_sensor
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation.placement import pose_from_rpy
from optshape_graph.target import Target

DISTANCES: tuple[float, ...] = tuple(float(d) for d in range(2, 41, 2))
"""Distances of the paper's sweep, metres."""

ORIENTATIONS: dict[str, tuple[float, float, float]] = {
    "face": (0.0, 0.0, 0.0),
    "extreme": tuple(np.radians([20.0, 30.0, 30.0])),
}
"""Orientations of the paper's sweep: roll, pitch, yaw, rad, R = Rx Ry Rz."""

_RAY_POINT = 150.0
_RISE_PER_RING = 0.01


@cache
def reference_sensor() -> SensorModel:
    """Return the sensor of the paper's simulator: a VLP-32C upside down, with bent elevations and without noise."""
    upright = load_sensor("vlp32c").elevations
    z = _RAY_POINT * np.sin(upright) + _RISE_PER_RING * np.arange(len(upright))
    elevations = -np.arctan2(z, _RAY_POINT * np.cos(upright))[::-1]
    return SensorModel(
        elevations, "reference-simulator", azimuth_step=float(np.radians(0.4)), range_noise=0.0, ring_bias=0.0
    )


def reference_pose(target: Target, distance: float, rpy: ArrayLike) -> Floats:
    """Return T_lidar_target (4, 4) with the crossing of a quadrilateral's diagonals at (distance, 0, 0).

    Args:
        target: with four vertices.
        distance: metres.
        rpy: (3,) roll, pitch, yaw, rad.

    Raises:
        InputError: not a quadrilateral.
    """
    if len(target) != 4:
        raise InputError(f"target '{target.name}' has {len(target)} vertices; only four have one crossing of diagonals")
    a, b, c, d = target.polygon
    along = np.linalg.solve(np.column_stack([c - a, b - d]), b - a)[0]
    crossing = np.array([0.0, *(a + along * (c - a))])
    T = pose_from_rpy([distance, 0.0, 0.0], rpy)
    T[:3, 3] -= T[:3, :3] @ crossing
    return T
