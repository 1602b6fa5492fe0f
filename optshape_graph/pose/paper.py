"""The door of the published method, for comparison: that of Huang, Clark and Grizzle (Section V).

Edge points are the two ends of each ring (one where the ring has one return), unweighted and without an inset. In
every iteration the already moved edge points are centred on their own mean, each is matched to the nearest infinite
line of the template, and the relaxation gives an increment, accepted only where the cost falls. It stops after 15
iterations, or when two successive increments agree to 1e-5. The alternation is local, and its covariance, from the
residuals alone, says nothing of that.
"""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.errors import EstimationError
from optshape_graph.factors.measurement import TemplateMeasurement, edge_rows, plane_rows
from optshape_graph.pose.certificate import Backend, solve_relaxation
from optshape_graph.pose.ends import fit_ends
from optshape_graph.pose.evidence import Evidence, Finding
from optshape_graph.se3 import apply, difference, transform
from optshape_graph.target import Target

MAX_ITERATIONS = 15
TOLERANCE = 1e-5


def find_as_paper(evidence: Evidence, backend: Backend) -> Finding:
    """Find a target's pose as the paper does; see `estimate_pose`.

    Args:
        evidence: of the scan, its angles as recorded.
        backend: solves the relaxation.

    Raises:
        EstimationError: fewer than three edge points.
    """
    edges, target = evidence.problem.edges, evidence.problem.target
    distinct = np.unique(edges.index, return_index=True)[1]
    points = edges.points[np.sort(distinct)]
    if len(points) < 3:
        raise EstimationError(f"{evidence.scan.name}: {len(points)} edge points determine no pose")
    T = _alternate(points, target, backend)

    measurement = _measurement(points, nearest_lines(apply(T, points), target), target, T)
    # The residuals are the only word on the noise that this method has.
    sigma = max(1e-4, float(np.sqrt(2 * measurement.error(T) / max(measurement.n_rows - 6, 1))))
    measurement = TemplateMeasurement.from_stack(measurement.stack / sigma, measurement.n_rows, T)
    moved = apply(T, edges.points)
    labels = nearest_lines(moved, target)
    return Finding(
        evidence=evidence,
        measurement=measurement,
        exact=measurement,
        shared=None,
        total_weight=measurement.n_rows / sigma**2,
        margin=np.inf,
        rival=None,
        log_likelihood=np.nan,
        labels=labels,
        inset=np.zeros(len(edges)),
        edge_sigma=np.full(len(edges), sigma),
        edge_residuals=(target.normals[labels] * moved[:, 1:]).sum(axis=1) - target.offsets[labels],
        ends=fit_ends(evidence.problem.ends, T[None], labels[None])[0],
    )


def nearest_lines(points: Floats, target: Target) -> Ints:
    """(N,) index of the edge line, infinite, nearest to each point (N, 3) of the target frame."""
    across = points[:, 1:] @ target.normals.T - target.offsets
    return np.asarray(np.abs(across).argmin(axis=1))


def _alternate(points: Floats, target: Target, backend: Backend) -> Floats:
    T, previous, cost = np.eye(4), np.eye(4), np.inf
    for iteration in range(MAX_ITERATIONS):
        moved = apply(T, points)
        centring = transform(np.eye(3), -moved.mean(axis=0))
        centred = apply(centring, moved)
        measurement = _measurement(centred, nearest_lines(centred, target), target, np.eye(4))
        relaxation = solve_relaxation(measurement.quadratic(), backend)
        increment = np.eye(4)
        if relaxation.cost < cost:
            cost, increment = relaxation.cost, relaxation.T_target_lidar
            T = increment @ centring @ T
        change = difference(previous, increment)
        if iteration and np.linalg.norm(change) < TOLERANCE:
            break
        previous = increment
    return T


def _measurement(points: Floats, labels: Ints, target: Target, T: Floats) -> TemplateMeasurement:
    A, r = edge_rows(points, target.normals[labels], target.offsets[labels])
    A_plane, r_plane = plane_rows(points)
    return TemplateMeasurement.from_rows(np.vstack([A, A_plane]), np.concatenate([r, r_plane]), T)
