"""Evidence that is free: where the rings that returned nothing would have met the target, and what lies outside it."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.edges import EdgePoints
from optshape_graph.pose.propagation import Posterior, Problem, interval_width
from optshape_graph.sensor import SensorModel


def vertices_in_lidar(T_target_lidar: Floats, vertices: Floats) -> Floats:
    """Vertices (C, n, 3), LiDAR frame, of a target (n, 3) at poses (C, 4, 4)."""
    return np.asarray((vertices - T_target_lidar[:, None, :3, 3]) @ T_target_lidar[:, :3, :3])


def chords(vertices: Floats, elevations: Floats, reference_azimuth: float) -> tuple[Floats, Floats]:
    """Azimuths between which rings meet convex polygons, exactly.

    The edge and the sensor span a plane with normal m; a ray of azimuth a and elevation e is on the inner side of it
    where m_x cos a + m_y sin a <= -m_z tan e, an arc in closed form. The chord is where all arcs meet.

    Args:
        vertices: (C, n, 3) polygons, LiDAR frame, metres.
        elevations: (R,) rad.
        reference_azimuth: rad, some azimuth of the target.

    Returns:
        Right and left end (C, R), rad, relative to the reference; right above left where the ring misses.
    """
    m = np.cross(vertices, np.roll(vertices, -1, axis=1))
    outward = -np.sign((m * vertices.mean(axis=1, keepdims=True)).sum(axis=-1, keepdims=True))
    m = m * outward
    across = np.hypot(m[..., 0], m[..., 1])
    centre = np.angle((-m[..., 0] - 1j * m[..., 1]) * np.exp(-1j * reference_azimuth))
    cosine = -m[..., 2, None] * np.tan(elevations) / np.maximum(across, 1e-300)[..., None]
    half = np.where(cosine < -1, -np.inf, np.pi - np.arccos(np.clip(cosine, -1, 1)))
    return (centre[..., None] - half).max(axis=1), (centre[..., None] + half).min(axis=1)


def missed_rings(
    edges: EdgePoints, sensor: SensorModel, vertices: Floats, across: Floats
) -> Floats:
    """Logarithm of the probability (C,) that the rings without returns return nothing.

    A ring that crosses the target by less than a step may fall between two firings. Beyond that it must have been
    lost: occluded, outside the field of view, dropped. How often that happens, the rings between the lowest and the
    highest that did return tell.

    Args:
        edges: ends of the rings that returned.
        sensor: whose table says which rings there are.
        vertices: (C, n, 3) of the target, LiDAR frame, metres.
        across: (C,) how far the boundary lies outside the returns beside quantisation, rad.
    """
    hit = np.unique(edges.ring)
    missed = np.setdiff1d(np.arange(sensor.n_rings), hit)
    inner = (missed > hit[0]) & (missed < hit[-1])
    lost = (inner.sum() + 1.0) / (hit[-1] - hit[0] + 10.0)
    right, left = chords(vertices, sensor.elevations[missed[~inner]], edges.reference_azimuth)
    with np.errstate(invalid="ignore"):
        steps = np.nan_to_num((left - right - 2 * across[:, None]) / edges.azimuth_step, neginf=0.0)
    unseen = np.clip(1.0 - steps, 0.0, 1.0)
    return np.asarray(np.log(unseen * (1 - lost) + lost).sum(axis=1))


def outside_returns(problem: Problem, posterior: Posterior) -> Floats:
    """Logarithm of the penalty (C,) for boundaries that lie beyond another edge than the one they are assigned to.

    Edge lines are infinite; the target is not. A boundary point that the assignment puts outside the polygon is
    improbable as a Gaussian across that edge says, down to the probability of a lost return.
    """
    geometry, target = posterior.geometry, problem.target
    T = posterior.T_target_lidar
    R, p = T[:, :3, :3], problem.edges.points
    y = p @ np.swapaxes(R, 1, 2) + T[:, None, :3, 3]
    ray = (p / np.linalg.norm(p, axis=1, keepdims=True)) @ np.swapaxes(R, 1, 2)
    yz = y[..., 1:] - ray[..., 1:] / ray[..., :1] * y[..., :1]
    beyond = (yz @ target.normals.T - target.offsets).max(axis=-1)
    # Returns themselves are inside, up to the common offset and what each may scatter.
    allowed = posterior.offset[:, None] * geometry.across
    width = interval_width(problem.edges) * np.linalg.norm(p, axis=1)
    sigma = np.hypot(posterior.sigma, 0.3 * width)
    excess = np.maximum(beyond + np.minimum(allowed, 0.0), 0.0) / sigma
    return np.asarray(np.maximum(-0.5 * excess**2, np.log(1e-2)).sum(axis=1))
