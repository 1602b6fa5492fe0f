"""Rays near a target: those that returned, and those that were fired."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.detection.segments import OrderedScan
from optshape_graph.se3 import inverse

_STEEP = 1e-3  # cosine of incidence below which a ray counts as parallel to the plane


@dataclass(frozen=True, eq=False, repr=False)
class Rays(Value):
    """Returned rays that pass near a target.

    Attributes:
        rows: (N,) of the ordered scan.
        crossing: (N, 2) points at which they meet the target's plane, target frame, metres.
        points: (N, 3) their returns, target frame, metres; x is the distance behind the plane, negative in front.
    """

    rows: Ints
    crossing: Floats
    points: Floats


def returned_near(scan: OrderedScan, T_lidar_target: Floats, radius: float) -> Rays:
    """Find the returned rays that pass within `radius`, metres, of a target's origin in its plane.

    Args:
        scan: the ordered scan.
        T_lidar_target: (4, 4) pose of the target.
        radius: metres.
    """
    T = inverse(T_lidar_target)
    near = scan.toward(T_lidar_target[:3, 3], radius)
    rays = scan.points.take(near, axis=0) @ T[:3, :3].T
    meets, crossing = _cross(rays, T[:3, 3], scan.range.take(near), radius)
    return Rays(near.take(meets), crossing, rays.take(meets, axis=0) + T[:3, 3])


def fired_near(scan: OrderedScan, T_lidar_target: Floats, radius: float) -> Floats:
    """Return where rays fired within `radius` of a target's origin meet its plane, (M, 2), metres.

    These are all rays, returned or not, with azimuths a step apart on every ring of the sensor.
    """
    centre, T = T_lidar_target[:3, 3], inverse(T_lidar_target)
    away, flat = float(np.linalg.norm(centre)), float(np.hypot(centre[0], centre[1]))
    half = np.arcsin(min(radius / away, 1.0)) if away > 0 else np.pi
    elevation = np.arcsin(centre[2] / away)
    rings = scan.elevations[np.abs(scan.elevations - elevation) <= half]
    half = np.arcsin(radius / flat) if radius < flat else np.pi
    azimuth = np.arctan2(centre[1], centre[0]) + np.arange(-half, half, scan.resolution.step)
    across = np.cos(rings)[:, None]
    directions = np.empty((len(rings), len(azimuth), 3))
    directions[..., 0] = across * np.cos(azimuth)
    directions[..., 1] = across * np.sin(azimuth)
    directions[..., 2] = np.sin(rings)[:, None]
    return _cross(directions.reshape(-1, 3) @ T[:3, :3].T, T[:3, 3], 1.0, radius)[1]


def _cross(rays: Floats, sensor: Floats, ranges: Floats | float, radius: float) -> tuple[Ints, Floats]:
    """Return which rays (M,) meet a target's plane within a radius of its origin, and where (M, 2), metres.

    Args:
        rays: (N, 3) along the axes of the target's frame.
        sensor: (3,) from which they come, target frame, metres.
        ranges: (N,) their lengths, or that of all.
        radius: metres.
    """
    x, y, z = rays.T
    ahead = x > _STEEP * ranges
    scale = -sensor[0] / np.where(ahead, x, 1.0)
    y, z = y * scale + sensor[1], z * scale + sensor[2]
    meets = np.flatnonzero(ahead & (y * y + z * z < radius**2))
    return meets, np.column_stack([y.take(meets), z.take(meets)])
