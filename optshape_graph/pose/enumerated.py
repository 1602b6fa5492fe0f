"""Our method: enumeration of the association, posterior of the pose, certificate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.edges import extract_edge_points
from optshape_graph.errors import EstimationError
from optshape_graph.factors.measurement import TemplateMeasurement, plane_rows, template_rows
from optshape_graph.factors.se3 import inverse, inverse_covariance
from optshape_graph.factors.static import BiasedMeasurement
from optshape_graph.pose.association import enumerate_poses, fit_plane
from optshape_graph.pose.estimate import (
    AMBIGUITY_MARGIN,
    Ambiguity,
    PoseEstimate,
    Status,
    unobservable_directions,
)
from optshape_graph.pose.evidence import missed_rings, outside_returns, vertices_in_lidar
from optshape_graph.pose.noise import EdgeNoise, PlaneNoise, plane_noise
from optshape_graph.pose.propagation import Posterior, Problem, edge_geometry, interval_width, propagate
from optshape_graph.pose.sdp import Backend, certify
from optshape_graph.scan import Scan
from optshape_graph.target import Target

MIN_EXPLAINED = 0.6
"""Share of ring ends that must end on the target's edges: fewer, and these are not this target's returns."""


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Posteriors with their log likelihoods, best first."""

    posterior: Posterior
    score: Floats


def estimate_enumerated(scan: Scan, target: Target, backend: Backend = "clarabel") -> PoseEstimate:
    """Estimate a target's pose from its returns; see `estimate_pose`."""
    edges = extract_edge_points(scan)
    plane = fit_plane(scan.points, scan.ring)
    returns = plane_noise(scan.points, scan.ring, plane.axes[0], scan.sensor)
    problem = Problem(edges, target, _plane_form(returns), EdgeNoise.of(scan.sensor))
    starts = enumerate_poses(edges, plane, target)
    candidates = _score(problem, _upright(starts, target), scan)

    best = candidates.posterior.select(slice(0, 1))
    shared, weight = _measurement(problem, best, returns)
    measurement = shared.marginal(1.0)
    T_target_lidar = refine(measurement)
    same = _same_mode(candidates.posterior, target)
    measurement = _widen(measurement.at(T_target_lidar), candidates, same)
    certificate, _ = certify(measurement, T_target_lidar, weight, backend)

    T_lidar_target = inverse(T_target_lidar)
    information = measurement.information(T_target_lidar) + 1e-9 * np.eye(6)
    covariance = inverse_covariance(T_target_lidar, np.linalg.inv(information))
    final = edge_geometry(problem, T_target_lidar[None], best.geometry.labels)
    inset, sigma = best.inset[0], best.sigma[0]
    residuals = final.residual[0] + inset * final.along[0]
    ambiguity = _ambiguity(candidates, same)
    unobservable = unobservable_directions(covariance, target.circumradius)
    explained = _explained(problem, final.residual[0], final.along[0], final.across[0], float(best.offset[0]))
    status, reason = _verdict(explained, len(edges), unobservable, ambiguity)
    return PoseEstimate(
        target=target,
        T_lidar_target=T_lidar_target,
        covariance=covariance,
        status=status,
        reason=reason,
        measurement=measurement,
        shared=shared,
        certificate=certificate,
        global_association=True,
        ambiguity=ambiguity,
        edge_points=edges,
        labels=best.geometry.labels[0],
        inset=inset,
        edge_sigma=sigma,
        edge_residuals=residuals,
        plane_rms=float(np.sqrt(np.mean((scan.points @ T_target_lidar[0, :3] + T_target_lidar[0, 3]) ** 2))),
        n_returns=len(scan),
        unobservable=unobservable,
    )


def refine(measurement: TemplateMeasurement, iterations: int = 20) -> Floats:
    """Return the T_target_lidar (4, 4) nearest to where a measurement was taken that minimises its error.

    Gauss-Newton steps on the compressed rows, with Levenberg's damping where the rows leave a direction free.
    """
    import gtsam

    T, error, damping = measurement.T_target_lidar, measurement.error(measurement.T_target_lidar), 1e-12
    for _ in range(iterations):
        information = measurement.information(T)
        damped = information + damping * np.trace(information) * np.eye(6)
        step = -np.linalg.solve(damped, measurement.gradient(T))
        candidate = T @ gtsam.Pose3.Expmap(step).matrix()
        new = measurement.error(candidate)
        if new > error:
            damping = max(1e-8, 10 * damping)
            if np.abs(step).max() < 1e-10 or damping > 1.0:
                break
            continue
        T, error = candidate, new
        if np.abs(step).max() < 1e-12:
            break
    return np.asarray(T)


def _plane_form(returns: PlaneNoise) -> Floats:
    """(13, 13) quadratic form in [z; 1] of the returns' distances from the plane, ring biases marginalised."""
    A, r = plane_rows(returns.points)
    rows = BiasedMeasurement.from_rows(A / returns.sigma[:, None], returns.bias, r / returns.sigma, np.eye(4))
    return rows.marginal(1.0).quadratic()


def _upright(T: Floats, target: Target) -> Floats:
    """Turn poses (C, 4, 4) by the target's symmetries so that its z axis is as nearly up as it gets."""
    if len(target.symmetries) == 1:
        return T
    S = np.array(target.symmetry_rotations)
    turned = np.swapaxes(S, 1, 2)[None] @ T[:, None, :3, :3]  # (T_lidar_target S)^-1 = S^T T_target_lidar
    best = turned[:, :, 2, 2].argmax(axis=1)
    rows = np.arange(len(T))
    result = T.copy()
    result[:, :3, :3] = turned[rows, best]
    result[:, :3, 3] = (np.swapaxes(S, 1, 2)[best] @ T[:, :3, 3:])[..., 0]
    return result


def _score(problem: Problem, starts: Floats, scan: Scan) -> _Candidates:
    """Posterior and log likelihood of each start, best first, each association once."""
    posterior = propagate(problem, starts)
    score = posterior.log_evidence + outside_returns(problem, posterior)
    if scan.sensor is not None:
        vertices = vertices_in_lidar(posterior.T_target_lidar, problem.target.vertices)
        score = score + missed_rings(problem.edges, scan.sensor, vertices, posterior.offset)
    score = np.where(np.isfinite(score), score, -np.inf)
    if not np.isfinite(score).any():
        raise EstimationError(f"{scan.name}: no pose explains the returns")
    order = np.argsort(-score, kind="stable")
    _, first = np.unique(posterior.geometry.labels[order], axis=0, return_index=True)
    kept = order[np.sort(first)]
    return _Candidates(posterior.select(kept), score[kept])


def _measurement(problem: Problem, best: Posterior, returns: PlaneNoise) -> tuple[BiasedMeasurement, float]:
    """All whitened rows of the best association, before shared errors are marginalised; and their total weight.

    The shared errors are the bias of each ring that the scan's sensor has and the offset across the edges, each in units of
    its standard deviation.
    """
    geometry, edges = best.geometry, problem.edges
    T = best.T_target_lidar[0]
    boundary = edges.points + best.inset[0][:, None] * edges.outward(T[0, :3])
    A, r = template_rows(boundary, geometry.direction[0], problem.target.offsets[geometry.labels[0]])
    sigma = best.sigma[0]
    A_plane, r_plane = plane_rows(returns.points)
    columns = np.zeros((len(A) + len(A_plane), returns.bias.shape[1] + 1))
    columns[: len(A), -1] = geometry.across[0] * problem.noise.common / sigma
    columns[len(A) :, :-1] = returns.bias
    shared = BiasedMeasurement.from_rows(
        np.vstack([A / sigma[:, None], A_plane / returns.sigma[:, None]]),
        columns,
        np.concatenate([r / sigma, r_plane / returns.sigma]),
        T,
    )
    return shared, float((1 / sigma**2).sum() + (1 / returns.sigma**2).sum())


def _same_mode(posterior: Posterior, target: Target) -> Ints:
    """(C,) whether each pose belongs to the same mode as the first: their regions of 3 standard deviations meet."""
    from scipy.spatial.transform import RigidTransform

    T = posterior.T_target_lidar
    xi = RigidTransform.from_matrix(inverse(T[0]) @ T).as_exp_coords()
    both = posterior.covariance + posterior.covariance[0]
    # Poses within a degree and a hundredth of the target are one pose, however sure each is of itself.
    size = target.circumradius
    floor = np.diag(np.array([1.0, 1.0, 1.0, size, size, size]) * np.array([0.02] * 3 + [0.01] * 3)) ** 2
    distance = np.einsum("ci,ci->c", xi, np.linalg.solve(both + floor, xi[..., None])[..., 0])
    return np.asarray(distance < 9.0)


def _widen(measurement: TemplateMeasurement, candidates: _Candidates, same: Ints) -> TemplateMeasurement:
    """Scale the measurement down for associations of the same mode that are nearly as likely as the best.

    Near a vertex a ring end may belong to either edge. The covariance of the mixture about the best pose, averaged over
    directions, is the best association's own times a factor of at least 1.
    """
    rows = np.flatnonzero(same)
    weight = np.exp(candidates.score[rows] - candidates.score[0])
    if len(rows) == 1 or weight[1:].sum() < 1e-3:
        return measurement
    from scipy.spatial.transform import RigidTransform

    weight /= weight.sum()
    posterior = candidates.posterior
    T = posterior.T_target_lidar
    xi = RigidTransform.from_matrix(inverse(T[0]) @ T[rows]).as_exp_coords()
    information = measurement.information(measurement.T_target_lidar)
    second_moment = np.einsum("c,cij->ij", weight, posterior.covariance[rows] + xi[:, :, None] * xi[:, None, :])
    factor = max(1.0, float(np.trace(information @ second_moment)) / 6.0)
    return TemplateMeasurement.from_stack(
        measurement.stack / np.sqrt(factor), measurement.n_rows, measurement.T_target_lidar
    )


def _ambiguity(candidates: _Candidates, same: Ints) -> Ambiguity:
    """Margin between the best mode, all its associations together, and the best pose outside it."""
    others = np.flatnonzero(~np.asarray(same))
    if not len(others):
        return Ambiguity(np.inf, None)
    score = candidates.score
    best = np.logaddexp.reduce(score[np.asarray(same)])
    rival = others[score[others].argmax()]
    return Ambiguity(float(best - score[rival]), inverse(candidates.posterior.T_target_lidar[rival]))


def _explained(problem: Problem, residual: Floats, along: Floats, across: Floats, offset: float) -> float:
    """Share of edge points whose boundary is within the interval that a last return leaves, give or take 3 sigma."""
    boundary = residual + np.maximum(along, 0.0) * 0.5 * interval_width(problem.edges) + offset * across
    half = np.abs(along) * 0.5 * interval_width(problem.edges)
    sigma = np.hypot(problem.noise.floor, problem.noise.own * across)
    return float(np.mean(np.abs(boundary) < half + 3 * sigma))


def _verdict(
    explained: float, n_points: int, unobservable: tuple[str, ...], ambiguity: Ambiguity
) -> tuple[Status, str]:
    if explained < MIN_EXPLAINED:
        count = round((1 - explained) * n_points)
        return "failed", f"{count} of {n_points} ring ends do not end on an edge: not this target, or its returns are mixed"
    if unobservable:
        return "failed", "not observable: " + "; ".join(unobservable)
    if ambiguity.margin < AMBIGUITY_MARGIN:
        return "ambiguous", f"a different pose is only {ambiguity.margin:.2g} less likely (log likelihood)"
    return "ok", ""
