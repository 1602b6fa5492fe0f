"""The method of Huang, Clark and Grizzle (Section V), for comparison.

Edge points are the two ends of each ring (one where the ring has one return), unweighted and without an inset. In
every iteration the already moved edge points are centred on their own mean, each is matched to the nearest infinite
line of the template, and the relaxation gives an increment, accepted only where the cost falls. It stops after 15
iterations, or when two successive increments agree to 1e-5. The alternation is local, and its covariance, from the
residuals alone, says nothing of that.
"""

from __future__ import annotations

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.edges import extract_edge_points
from optshape_graph.errors import EstimationError
from optshape_graph.factors.measurement import TemplateMeasurement, edge_rows, plane_rows
from optshape_graph.factors.se3 import inverse, inverse_covariance
from optshape_graph.pose.estimate import Ambiguity, PoseEstimate, unobservable_directions
from optshape_graph.pose.sdp import Backend, certify, solve_relaxation
from optshape_graph.scan import Scan
from optshape_graph.target import Target

MAX_ITERATIONS = 15
TOLERANCE = 1e-5


def estimate_as_paper(scan: Scan, target: Target, backend: Backend = "clarabel") -> PoseEstimate:
    """Estimate a target's pose as the paper does; see `estimate_pose`.

    Raises:
        EstimationError: fewer than three edge points.
    """
    edges = extract_edge_points(scan)
    distinct = np.unique(edges.index, return_index=True)[1]
    points = edges.points[np.sort(distinct)]
    if len(points) < 3:
        raise EstimationError(f"{scan.name}: {len(points)} edge points determine no pose")
    T = _alternate(points, target, backend)

    labels = nearest_lines(_moved(T, points), target)
    measurement = _measurement(points, labels, target, T)
    # The residuals are the only word on the noise that this method has.
    sigma = max(1e-4, float(np.sqrt(2 * measurement.error(T) / max(measurement.n_rows - 6, 1))))
    measurement = TemplateMeasurement.from_stack(measurement.stack / sigma, measurement.n_rows, T)
    certificate = certify(measurement, T, measurement.n_rows / sigma**2, backend)
    information = measurement.information(T) + 1e-9 * np.eye(6)
    covariance = inverse_covariance(T, np.linalg.inv(information))
    all_labels = nearest_lines(_moved(T, edges.points), target)
    moved = _moved(T, edges.points)
    unobservable = unobservable_directions(covariance, target.circumradius)
    return PoseEstimate(
        target=target,
        T_lidar_target=inverse(T),
        covariance=covariance,
        status="failed" if unobservable else "ok",
        reason="not observable: " + "; ".join(unobservable) if unobservable else "",
        measurement=measurement,
        shared=None,
        certificate=certificate,
        global_association=False,
        log_likelihood=np.nan,
        ambiguity=Ambiguity(np.inf, None),
        edge_points=edges,
        labels=all_labels,
        inset=np.zeros(len(edges)),
        edge_sigma=np.full(len(edges), sigma),
        edge_residuals=(target.normals[all_labels] * moved[:, 1:]).sum(axis=1) - target.offsets[all_labels],
        plane_rms=float(np.sqrt(np.mean(_moved(T, scan.points)[:, 0] ** 2))),
        n_returns=len(scan),
        unobservable=unobservable,
    )


def nearest_lines(points: Floats, target: Target) -> Ints:
    """(N,) index of the edge line, infinite, nearest to each point (N, 3) of the target frame."""
    across = points[:, 1:] @ target.normals.T - target.offsets
    return np.asarray(np.abs(across).argmin(axis=1))


def _alternate(points: Floats, target: Target, backend: Backend) -> Floats:
    T, previous, cost = np.eye(4), np.eye(4), np.inf
    for iteration in range(MAX_ITERATIONS):
        moved = _moved(T, points)
        centring = np.eye(4)
        centring[:3, 3] = -moved.mean(axis=0)
        centred = _moved(centring, moved)
        measurement = _measurement(centred, nearest_lines(centred, target), target, np.eye(4))
        relaxation = solve_relaxation(measurement.quadratic(), backend)
        increment = np.eye(4)
        if relaxation.cost < cost:
            cost, increment = relaxation.cost, relaxation.T_target_lidar
            T = increment @ centring @ T
        change = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(previous) @ increment))
        if iteration and np.linalg.norm(change) < TOLERANCE:
            break
        previous = increment
    return T


def _measurement(points: Floats, labels: Ints, target: Target, T: Floats) -> TemplateMeasurement:
    A, r = edge_rows(points, target.normals[labels], target.offsets[labels])
    A_plane, r_plane = plane_rows(points)
    return TemplateMeasurement.from_rows(np.vstack([A, A_plane]), np.concatenate([r, r_plane]), T)


def _moved(T: Floats, points: Floats) -> Floats:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])
