"""Evidence that is free: where the rings that returned nothing would have met the target, and what lies outside it."""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr

from optshape_graph._arrays import Floats, Ints
from optshape_graph.edges import EdgePoints
from optshape_graph.pose.noise import LOST_RETURNS
from optshape_graph.pose.propagation import Posterior, Problem, own_variance
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


def share_lost(edges: EdgePoints) -> float:
    """Share of rings that return nothing though they meet the target, from those between the lowest and highest."""
    between = edges.ring[-1] - edges.ring[0] + 1
    return float((between - edges.n_rings + 1.0) / (between + 9.0))


def missed_rings(edges: EdgePoints, sensor: SensorModel, vertices: Floats, lost_width: Floats) -> Floats:
    """Logarithm of the probability (C,) that the rings without returns return nothing.

    A ring that crosses the target by less than a step may fall between two firings. Beyond that it must have been
    lost: occluded, outside the field of view, dropped. How often that happens, the rings between the lowest and the
    highest that did return tell.

    Args:
        edges: ends of the rings that returned.
        sensor: whose table says which rings there are.
        vertices: (C, n, 3) of the target, LiDAR frame, metres.
        lost_width: (C,) how much narrower the target seems to the rings, beside quantisation, rad.
    """
    lowest, highest = edges.ring[0], edges.ring[-1]
    lost = share_lost(edges)
    outer = np.delete(sensor.elevations, slice(lowest, highest + 1))
    right, left = chords(vertices, outer, edges.reference_azimuth)
    with np.errstate(invalid="ignore"):
        steps = np.nan_to_num((left - right - lost_width[:, None]) / edges.azimuth_step, neginf=0.0)
    unseen = np.clip(1.0 - steps, 0.0, 1.0)
    return np.asarray(np.log(unseen * (1 - lost) + lost).sum(axis=1))


def other_edges(problem: Problem, posterior: Posterior) -> Floats:
    """Distance (C, M, n), metres, of boundary points beyond each edge line; -inf for the edge each is assigned to."""
    geometry, target = posterior.geometry, problem.target
    T = posterior.T_target_lidar
    boundary = _boundary(problem, posterior)
    y = (boundary @ np.swapaxes(T[:, :3, :3], 1, 2)) + T[:, None, :3, 3]
    beyond = y[..., 1:] @ target.normals.T - target.offsets
    np.put_along_axis(beyond, geometry.labels[..., None], -np.inf, axis=-1)
    return np.asarray(beyond)


def _boundary(problem: Problem, posterior: Posterior) -> Floats:
    """(C, M, 3) where the posterior puts the boundary that each edge point stands for, LiDAR frame, on the plane."""
    T, edges = posterior.T_target_lidar, problem.edges
    normal = T[:, 0, :3]
    ray = edges.points + (posterior.inset + posterior.shift)[..., None] * edges.sweep
    return np.asarray(ray * (-T[:, 0, 3, None] / np.einsum("ci,cmi->cm", normal, ray))[..., None])


def exit_probability(problem: Problem, posterior: Posterior) -> Floats:
    """Logarithm of the probability (C,) that each ring leaves the target by the edge it is assigned to.

    Edge lines are infinite; the target is not: a boundary point must be inside all other edges, as far as the
    pose and the point's own scatter tell, down to the probability of a lost return.
    """
    beyond = other_edges(problem, posterior)
    worst = beyond.argmax(axis=-1)
    R = posterior.T_target_lidar[:, :3, :3]
    normal = np.concatenate([np.zeros((*worst.shape, 1)), problem.target.normals[worst]], axis=-1) @ R
    J = np.concatenate([np.cross(_boundary(problem, posterior), normal), normal], axis=-1)
    variance = ((J @ posterior.covariance) * J).sum(axis=-1)
    variance += own_variance(problem, posterior.geometry)
    inside = log_ndtr(-np.take_along_axis(beyond, worst[..., None], axis=-1)[..., 0] / np.sqrt(variance))
    return np.asarray(np.maximum(inside, np.log(0.1 * LOST_RETURNS)).sum(axis=1))


def alternative_labels(problem: Problem, posterior: Posterior, limit: int) -> Ints:
    """Labels (V, M) of the associations that differ from a posterior's in one edge point near a vertex.

    Args:
        problem: one target in one scan.
        posterior: of one pose.
        limit: at most so many, those nearest to a vertex.
    """
    beyond = other_edges(problem, posterior)[0]
    nearest = beyond.argmax(axis=-1)
    reach = 0.5 * np.abs(posterior.geometry.along[0]) * problem.edges.width
    closeness = -beyond.max(axis=-1) / (posterior.sigma[0] + reach)
    order = np.argsort(closeness)[:limit]
    order = order[closeness[order] < 1.0]
    labels = np.repeat(posterior.geometry.labels, len(order), axis=0)
    labels[np.arange(len(order)), order] = nearest[order]
    return labels
