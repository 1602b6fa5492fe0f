"""The door of scans with rings: which edge does each ring end on, and where is the target then?

Every consistent association of ring ends to edges gives a start (`association`); expectation propagation finds the
posterior of the pose about each (`propagation`); the starts are ranked and gathered in modes, and the best is compared
with the next (`modes`). What the best mode's associations say of the edges, and all returns of the plane, is compressed
into one measurement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.edges import EdgePoints, extract_edge_points, with_top_and_bottom
from optshape_graph.factors.measurement import TemplateMeasurement, refine, template_rows
from optshape_graph.factors.static import EDGE_OFFSET, BiasedMeasurement, SharedError
from optshape_graph.pose.association import ReturnsPlane, enumerate_poses, fit_plane
from optshape_graph.pose.azimuth_grid import level_rings, place_on_firings
from optshape_graph.pose.modes import Modes, SampledPose, compare_modes, rank
from optshape_graph.pose.noise import EdgeNoise, PlaneReturns, plane_measurement, returns_on_plane
from optshape_graph.pose.options import PoseOptions
from optshape_graph.pose.propagation import EdgeGeometry, Posterior, Problem, edge_geometry
from optshape_graph.pose.result import Ambiguity, Finding
from optshape_graph.scan import Scan
from optshape_graph.se3 import difference, vec, vec_derivative
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class Measured(Value):
    """What was measured, whatever the pose.

    Attributes:
        scan: the returns, angles put right.
        edges: both ends of each ring, on the grid of firings.
        plane: of the returns.
        returns: all returns against a plane near the target's.
        on_plane: the same, compressed.
        problem: the target in this scan.
    """

    scan: Scan
    edges: EdgePoints
    plane: ReturnsPlane
    returns: PlaneReturns
    on_plane: BiasedMeasurement
    problem: Problem


def measure(scan: Scan, target: Target, options: PoseOptions) -> Measured:
    """Find both ends of each ring and the plane of the returns, with their noise.

    Raises:
        EstimationError: the returns span no plane, or no azimuth step is to be found.
    """
    scan, angular_noise = level_rings(scan)
    edges = place_on_firings(extract_edge_points(scan), scan, angular_noise)
    plane = fit_plane(scan.points, scan.ring)
    returns = returns_on_plane(scan, plane.axes[0], plane.distance, angular_noise, options)
    on_plane = plane_measurement(returns)
    bounded = edges if angular_noise else _bounded(edges, scan)
    problem = Problem(bounded, target, on_plane.marginal(1.0).quadratic(), EdgeNoise.of(scan.sensor, options))
    return Measured(scan, edges, plane, returns, on_plane, problem)


def find_candidates(measured: Measured) -> Posterior:
    """Find the posterior of the pose under every association that is worth it, likeliest first.

    Raises:
        EstimationError: no pose explains the returns.
    """
    starts = enumerate_poses(measured.edges, measured.plane, measured.problem.target)
    return rank(measured.problem, starts, measured.scan, measured.edges)


def find_by_rings(scan: Scan, target: Target, options: PoseOptions) -> Finding:
    """Find a target's pose by the edges on which its rings end; see `estimate_pose`.

    Raises:
        EstimationError: the returns determine no pose at all.
    """
    measured = measure(scan, target, options)
    scan, edges, problem, on_plane = measured.scan, measured.edges, measured.problem, measured.on_plane
    modes = compare_modes(find_candidates(measured), problem, scan, edges)

    # The best mode in one measurement, at its minimum.
    best, n = modes.candidates.select(slice(0, 1)), len(edges)
    if modes.sampled is None:
        on_edges, edge_weight = _edge_measurement(problem, modes)
        shared = on_edges + on_plane
        measurement = shared.marginal(1.0)
        measurement = _widen(measurement.at(refine(measurement)), modes)
        offset, labels = float(best.offset[0]), best.geometry.labels
    else:
        on_edges, edge_weight = sampled_measurement(modes.sampled, on_plane)
        shared = on_edges + on_plane
        measurement = shared.marginal(1.0).at(modes.sampled.T_target_lidar)
        measurement = measurement.at(refine(measurement))
        offset, labels = modes.sampled.offset, None

    # How the ring ends lie about the edges there.
    final = edge_geometry(problem, measurement.T_target_lidar[None], labels)
    return Finding(
        target=target,
        returns=scan,
        measurement=measurement,
        shared=shared,
        total_weight=edge_weight + float((1 / measured.returns.sigma**2).sum()),
        ambiguity=Ambiguity(modes.margin, modes.rival),
        log_likelihood=modes.log_likelihood,
        edge_points=edges,
        labels=final.labels[0, :n],
        inset=best.inset[0, :n],
        edge_sigma=best.sigma[0, :n],
        edge_residuals=(final.residual[0] + best.inset[0] * final.along[0])[:n],
        objection=_objection(problem, final, offset, options.min_explained),
    )


def _bounded(edges: EdgePoints, scan: Scan) -> EdgePoints:
    """Add that the target ends before the next ring: exact angles are taken for granted.

    Where rings in between are lost, the next one may be lost too. (With noisy azimuths a lone return of the outermost
    ring may lie beside the target.) Neither bounds anything.
    """
    complete = edges.n_rings == edges.ring[-1] - edges.ring[0] + 1
    return with_top_and_bottom(edges, scan) if complete else edges


def _edge_measurement(problem: Problem, modes: Modes) -> tuple[BiasedMeasurement, float]:
    """Boundary points against their edges, before the offset that they share is marginalised; and their weight.

    Near a vertex a ring end may belong to either edge, so associations of the best mode that are nearly as likely
    take part: a weighted mean of their costs is a cost of the same form. Its minimum is near the mixture's mean where
    a weight is the association's probability over how sure that association is of its pose, against the others.

    Returns:
        The measurement, and the sum of 1 / sigma^2, 1/m2.
    """
    weight, posterior = modes.weights, modes.candidates
    covariance = posterior.covariance
    mean = np.einsum("c,cij->ij", weight, covariance)
    weight = weight / np.trace(np.linalg.solve(covariance, mean), axis1=1, axis2=2)
    weight /= weight.sum()
    rows, total = [], 0.0
    for k in np.flatnonzero(weight):
        one = posterior.select(slice(k, k + 1))
        geometry, sigma = one.geometry, one.sigma[0]
        boundary = problem.edges.points + one.inset[0][:, None] * problem.edges.outward(one.T_target_lidar[0, 0, :3])
        A, r = template_rows(
            boundary, geometry.direction[0], problem.target.offsets[geometry.labels[0]] + geometry.shift[0]
        )
        offset = geometry.across[0] * problem.noise.COMMON
        whitened = np.column_stack([offset, A, r]) / sigma[:, None]
        shifts = _without_shifts(problem.ring_shifts * (geometry.along[0] / sigma)[:, None])
        rows.append(np.sqrt(weight[k]) * shifts @ whitened)
        total += float(weight[k] * (1 / sigma**2).sum())
    stack = np.vstack(rows)
    measurement = BiasedMeasurement.from_rows(
        stack[:, 1:13],
        stack[:, :1],
        stack[:, 13],
        posterior.T_target_lidar[0],
        [SharedError(EDGE_OFFSET)],
    )
    return replace(measurement, n_rows=len(problem.edges)), total


def sampled_measurement(sampled: SampledPose, on_plane: BiasedMeasurement) -> tuple[BiasedMeasurement, float]:
    """Say of the edges what, with the plane, makes the pose that was sampled, its covariance and the offset's.

    Near the mean (R0, t0) a right perturbation (w, v) is linear in z = [vec R; t]: w is half of what is skew in
    R0^T R, and v = R0^T (t - t0). w vanishes for a half turn too; two rows of second order, the diagonal of R0^T R less
    1, tell that apart.

    Returns:
        The measurement, in z and the common offset, and the sum of 1 / sigma^2, 1/m2.
    """
    T = sampled.T_target_lidar
    scale = np.append(np.ones(6), EdgeNoise.COMMON)
    total = np.linalg.inv(sampled.covariance) * np.outer(scale, scale)
    elsewhere, pull = np.zeros((7, 7)), np.zeros(7)  # of the plane, and of the offset's prior
    plane = on_plane.marginal(1.0).at(T)
    J = plane.jacobian(T)
    elsewhere[:6, :6], elsewhere[6, 6] = J.T @ J, 1.0
    pull[:6], pull[6] = J.T @ plane.residual(T), sampled.offset / EdgeNoise.COMMON
    # What is left is the edges'. Where samples scatter more than the plane alone would let them, almost nothing is.
    root = np.linalg.cholesky(total)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, total - elsewhere).T))
    values = np.maximum(values, 1e-3)
    whiten = np.sqrt(values)[:, None] * (root @ vectors).T
    constant = whiten @ np.append(np.zeros(6), -sampled.offset / EdgeNoise.COMMON) - np.linalg.solve(whiten.T, pull)
    K = 0.5 * vec_derivative(T).T
    K[3:] *= 2.0
    straight = np.array([_diagonal(T, axis) for axis in (1, 2)]) * np.sqrt(0.5 * total[0, 0])
    A = np.vstack([whiten[:, :6] @ K, straight])
    r = np.concatenate([constant - whiten[:, :6] @ K @ vec(T), -np.full(2, np.sqrt(0.5 * total[0, 0]))])
    B = np.concatenate([whiten[:, 6], np.zeros(2)])[:, None]
    measurement = BiasedMeasurement.from_rows(A, B, r, T, [SharedError(EDGE_OFFSET)])
    return measurement, float(np.trace(total[4:6, 4:6]))


def _diagonal(T: Floats, axis: int) -> Floats:
    """(12,) row of an entry on the diagonal of R0^T R in z, for T = (R0, t0) (4, 4)."""
    entry = np.zeros((4, 3))
    entry[axis] = T[:3, axis]  # column by column
    return entry.ravel()


def _without_shifts(B: Floats) -> Floats:
    """(M, M) matrix that whitens rows which unit-variance errors, columns B (M, K) of disjoint rows, share."""
    B = B[:, B.any(axis=0)]
    square = (B**2).sum(axis=0)
    return np.asarray(np.eye(len(B)) - (B * ((1 - 1 / np.sqrt(1 + square)) / square)) @ B.T)


def _widen(measurement: TemplateMeasurement, modes: Modes) -> TemplateMeasurement:
    """Scale the measurement down where associations of the best mode disagree about the pose.

    The covariance of the mixture about the estimate, averaged over directions, is the measurement's own times a
    factor of at least 1.
    """
    weight, posterior = modes.weights, modes.candidates
    rows = np.flatnonzero(weight)
    if len(rows) == 1:
        return measurement
    xi = difference(measurement.T_target_lidar, posterior.T_target_lidar[rows])
    second_moment = np.einsum("c,cij->ij", weight[rows], posterior.covariance[rows] + xi[:, :, None] * xi[:, None, :])
    factor = max(1.0, float(np.trace(measurement.information() @ second_moment)) / 6.0)
    return TemplateMeasurement.from_stack(
        measurement.stack / np.sqrt(factor), measurement.n_rows, measurement.T_target_lidar
    )


def _objection(problem: Problem, geometry: EdgeGeometry, offset: float, min_explained: float) -> str:
    """Say how many ring ends lie elsewhere than a last return may, give or take 3 sigma, where those are too many."""
    along = geometry.along[0]
    boundary = geometry.residual[0] + offset * geometry.across[0] + along * problem.edges.middle
    half = np.abs(along) * 0.5 * problem.edges.width
    scatter = np.sqrt(geometry.own[0] + (problem.edges.shift * along) ** 2)
    explained = np.abs(boundary) < half + 3 * scatter
    if explained.mean() >= min_explained:
        return ""
    count = f"{(~explained).sum()} of {len(explained)}"
    return f"{count} ring ends do not end on an edge: not this target, or its returns are mixed"
