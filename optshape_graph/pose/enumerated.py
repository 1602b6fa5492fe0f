"""Our method: enumeration of the association, posterior of the pose, certificate."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from optshape_graph._arrays import Bools, Floats
from optshape_graph.edges import EdgePoints, extract_edge_points, with_top_and_bottom
from optshape_graph.errors import EstimationError
from optshape_graph.factors.measurement import TemplateMeasurement, template_rows
from optshape_graph.factors.se3 import inverse, inverse_covariance
from optshape_graph.factors.static import BiasedMeasurement
from optshape_graph.pose.angles import level_rings
from optshape_graph.pose.association import enumerate_poses, fit_plane
from optshape_graph.pose.estimate import (
    AMBIGUITY_MARGIN,
    Ambiguity,
    PoseEstimate,
    Status,
    unobservable_directions,
)
from optshape_graph.pose.evidence import alternative_labels, exit_probability, missed_rings, vertices_in_lidar
from optshape_graph.pose.fit import Evidence, Fit, measure_fit
from optshape_graph.pose.firing import place_on_firings
from optshape_graph.pose.likelihood import Firings
from optshape_graph.pose.modes import Candidates, log, modes_by_association, modes_by_samples
from optshape_graph.pose.noise import EdgeNoise, plane_measurement, returns_on_plane
from optshape_graph.pose.propagation import (
    EdgeGeometry,
    Posterior,
    Problem,
    concatenate,
    edge_geometry,
    own_variance,
    propagate,
    ring_shifts,
)
from optshape_graph.pose.outline import fit_ends, tilt_of_rings
from optshape_graph.pose.surface import SEEN, PlaneResiduals, surface
from optshape_graph.pose.sdp import Backend, certify
from optshape_graph.scan import Scan
from optshape_graph.target import Target

MIN_EXPLAINED = 0.8
"""Share of ring ends that must end on the target's edges: fewer, and these are not this target's returns."""


_ALTERNATIVES = 6
"""How many associations next to the best take part in the estimate."""


def estimate_enumerated(scan: Scan, target: Target, backend: Backend = "clarabel") -> PoseEstimate:
    """Estimate a target's pose from its returns; see `estimate_pose`.

    Raises:
        EstimationError: the returns determine no pose at all.
    """
    tilt = tilt_of_rings(scan)
    scan, angular_noise = level_rings(scan)
    edges = place_on_firings(extract_edge_points(scan), scan, angular_noise)
    plane = fit_plane(scan.points, scan.ring)
    returns = returns_on_plane(scan.points, scan.ring, plane.axes[0], plane.distance, scan.sensor, angular_noise)
    off_plane = PlaneResiduals.of_returns(returns, plane, target)
    shape = surface(off_plane)
    noise_factor, bias_factor = off_plane.noise / off_plane.file_noise, off_plane.bias / off_plane.file_bias
    widened = returns.widened(noise_factor, bias_factor)
    names = [f"range bias of ring {k}" for k in returns.rings]
    if shape.size > 0:
        widened = widened.with_shared(2 * shape.size * off_plane.terms[:, :3])
        names += ["surface offset", "surface tilt about z", "surface tilt about y"]
    if off_plane.excess > 0:
        widened = widened.with_shared(np.full((len(scan), 1), off_plane.excess))
        names.append("range offset")
    on_plane = plane_measurement(widened.select(off_plane.usual), names)
    # Where rings in between are lost, the next one may be lost too; with noisy azimuths a lone return of the outermost
    # ring may lie beside the target. Neither bounds anything.
    complete = edges.n_rings == edges.ring[-1] - edges.ring[0] + 1
    bounded = with_top_and_bottom(edges, scan) if complete and not angular_noise else edges
    problem = Problem(bounded, target, on_plane.marginal(1.0).quadratic(), EdgeNoise.of(scan.sensor))
    starts = enumerate_poses(edges, plane, target)
    candidates = _score(problem, _upright(starts, target), scan, edges)

    # The likelihood itself is known of beams without width; a beam's own scatter is in the posteriors alone.
    if problem.noise.ideal and not edges.scatter.any():
        modes = modes_by_samples(candidates, problem, Firings.of(edges, scan, problem.noise.lost))
    else:
        modes = modes_by_association(candidates, target)
    candidates, same, ambiguity = modes.candidates, modes.best, modes.ambiguity
    on_edges, edge_weight = _edge_measurement(problem, candidates, same)
    first = candidates.posterior.select(slice(0, 1))
    ends = fit_ends(replace(problem, edges=edges), first.T_target_lidar[0], first.geometry.labels[0, : len(edges)])
    edge_factor = float(np.sqrt(max(1.0, ends.clipped_mean_square / 1.15)))
    if ends.strain_probability < SEEN:
        on_edges, edge_weight = _edge_measurement(problem, candidates, same, ends.strain)
    on_edges, edge_weight = replace(on_edges, stack=on_edges.stack / edge_factor), edge_weight / edge_factor**2
    shared = on_edges + on_plane
    measurement = shared.marginal(1.0)
    T_target_lidar = refine(measurement)
    measurement = _widen(measurement.at(T_target_lidar), candidates, same)
    certificate = certify(measurement, T_target_lidar, edge_weight + float((1 / returns.sigma**2).sum()), backend)

    T_lidar_target = inverse(T_target_lidar)
    information = measurement.information(T_target_lidar) + 1e-9 * np.eye(6)
    covariance = inverse_covariance(T_target_lidar, np.linalg.inv(information))
    best = candidates.posterior.select(slice(0, 1))
    final = edge_geometry(problem, T_target_lidar[None], best.geometry.labels)
    inset, sigma = best.inset[0], best.sigma[0]
    residuals = final.residual[0] + inset * final.along[0]
    unobservable = unobservable_directions(covariance, target.circumradius)
    explained = _explained(problem, final, float(best.offset[0]))
    evidence = Evidence(scan, target, T_target_lidar, off_plane, shape, edges, ends, problem.noise, tilt)
    fit = measure_fit(evidence, edge_factor, 0, [])
    status, reason = _verdict(explained, len(problem.edges), unobservable, ambiguity, fit)
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
        log_likelihood=float(np.logaddexp.reduce(candidates.score[same])),
        edge_points=edges,
        labels=best.geometry.labels[0, : len(edges)],
        inset=inset[: len(edges)],
        edge_sigma=sigma[: len(edges)],
        edge_residuals=residuals[: len(edges)],
        plane_rms=float(np.sqrt(np.mean((scan.points @ T_target_lidar[0, :3] + T_target_lidar[0, 3]) ** 2))),
        n_returns=len(scan),
        unobservable=unobservable,
        fit=fit,
    )


def refine(measurement: TemplateMeasurement, iterations: int = 20) -> Floats:
    """Return the T_target_lidar (4, 4) nearest to where a measurement was taken that minimises its error.

    Gauss-Newton steps on the compressed rows, with Levenberg's damping where they do not lead down.
    """
    T, damping = measurement.T_target_lidar, 1e-12
    error = measurement.error(T)
    for _ in range(iterations):
        J = measurement.jacobian(T)
        information = J.T @ J
        damped = information + damping * np.trace(information) * np.eye(6)
        step = -np.linalg.solve(damped, J.T @ measurement.residual(T))
        candidate = T @ gtsam.Pose3.Expmap(step).matrix()
        new = measurement.error(candidate)
        if new <= error:
            T, error, damping = candidate, new, max(damping / 10, 1e-12)
        else:
            damping = max(10 * damping, 1e-8)
        if np.abs(step).max() < 1e-9 or damping > 1.0:
            break
    return np.asarray(T)


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


def _score(problem: Problem, starts: Floats, scan: Scan, ends: EdgePoints) -> Candidates:
    """Posterior and log likelihood of each start, best first, each association once.

    A first round tells the starts apart. A second works out the best and the associations next to it.
    """
    first = _rank(problem, propagate(problem, starts, relinearisations=1, sweeps=2), scan, ends)
    best = first.posterior.select(slice(0, 1))
    labels = np.vstack([best.geometry.labels, alternative_labels(problem, best, _ALTERNATIVES)])
    T = np.repeat(best.T_target_lidar, len(labels), axis=0)
    second = _rank(problem, propagate(problem, T, relinearisations=1, labels=labels, sweeps=4), scan, ends)
    merged = concatenate(second.posterior, first.posterior)
    return _distinct(merged, np.concatenate([second.score, first.score]))


def _rank(problem: Problem, posterior: Posterior, scan: Scan, ends: EdgePoints) -> Candidates:
    score = posterior.log_evidence + exit_probability(problem, posterior)
    if scan.sensor is not None:
        vertices = vertices_in_lidar(posterior.T_target_lidar, problem.target.vertices)
        ranges = np.linalg.norm(problem.edges.points, axis=1)
        lost_width = 2 * posterior.offset * float(np.mean(problem.noise.width(ranges) / ranges))
        score = score + missed_rings(ends, scan.sensor, vertices, lost_width)
    score = np.where(np.isfinite(score), score, -np.inf)
    if not np.isfinite(score).any():
        raise EstimationError(f"{scan.name}: no pose explains the returns")
    return _distinct(posterior, score)


def _distinct(posterior: Posterior, score: Floats) -> Candidates:
    """Each association once, as first listed; best first."""
    firsts: dict[bytes, int] = {}
    for k, labels in enumerate(posterior.geometry.labels):
        firsts.setdefault(labels.tobytes(), k)
    index = np.array(list(firsts.values()))
    kept = index[np.argsort(-score[index], kind="stable")]
    return Candidates(posterior.select(kept), score[kept])


def _edge_measurement(problem: Problem, candidates: Candidates, same: Bools, strain: float = 0.0) -> tuple[BiasedMeasurement, float]:
    """Boundary points against their edges, before the offset that they share is marginalised; and their weight.

    Near a vertex a ring end may belong to either edge, so associations of the best mode that are nearly as likely
    take part: a weighted mean of their costs is a cost of the same form. Its minimum is near the mixture's mean where
    a weight is the association's probability over how sure that association is of its pose, against the others.

    Returns:
        The measurement, and the sum of 1 / sigma^2, 1/m2.
    """
    weight = _weights(candidates, same)
    covariance = candidates.posterior.covariance
    mean = np.einsum("c,cij->ij", weight, covariance)
    weight = weight / np.trace(np.linalg.solve(covariance, mean), axis1=1, axis2=2)
    weight /= weight.sum()
    rows, total = [], 0.0
    for k in np.flatnonzero(weight):
        one = candidates.posterior.select(slice(k, k + 1))
        geometry, sigma = one.geometry, one.sigma[0]
        boundary = problem.edges.points + one.inset[0][:, None] * problem.edges.outward(one.T_target_lidar[0, 0, :3])
        A, r = template_rows(
            boundary, geometry.direction[0], problem.target.offsets[geometry.labels[0]] + geometry.shift[0]
        )
        offset = geometry.across[0] * problem.noise.COMMON
        q = (boundary @ one.T_target_lidar[0, 1:3, :3].T + one.T_target_lidar[0, 1:3, 3]).T
        n = problem.target.normals[geometry.labels[0]].T
        stretched = strain * np.column_stack([n[0] * q[0] - n[1] * q[1], n[0] * q[1] + n[1] * q[0]])
        whitened = np.column_stack([offset, stretched, A, r]) / sigma[:, None]
        shifts = _without_shifts(ring_shifts(problem.edges) * (geometry.along[0] / sigma)[:, None])
        rows.append(np.sqrt(weight[k]) * shifts @ whitened)
        total += float(weight[k] * (1 / sigma**2).sum())
    stack = np.vstack(rows)
    measurement = BiasedMeasurement.from_rows(
        stack[:, 3:15],
        stack[:, :3],
        stack[:, 15],
        candidates.posterior.T_target_lidar[0],
        shared=["offset across edges", "aspect", "shear"],
    )
    return replace(measurement, n_rows=len(problem.edges)), total


def _without_shifts(B: Floats) -> Floats:
    """(M, M) matrix that whitens rows which unit-variance errors, columns B (M, K) of disjoint rows, share."""
    B = B[:, B.any(axis=0)]
    square = (B**2).sum(axis=0)
    return np.asarray(np.eye(len(B)) - (B * ((1 - 1 / np.sqrt(1 + square)) / square)) @ B.T)


def _weights(candidates: Candidates, same: Bools) -> Floats:
    """(C,) probability of each association, within the best mode; those below a thousandth count as 0."""
    weight = np.where(same, np.exp(np.minimum(candidates.score - candidates.score[0], 0.0)), 0.0)
    weight[weight < 1e-3] = 0.0
    return np.asarray(weight / weight.sum())


def _widen(measurement: TemplateMeasurement, candidates: Candidates, same: Bools) -> TemplateMeasurement:
    """Scale the measurement down where associations of the best mode disagree about the pose.

    The covariance of the mixture about the estimate, averaged over directions, is the measurement's own times a
    factor of at least 1.
    """
    weight = _weights(candidates, same)
    rows = np.flatnonzero(weight)
    if len(rows) == 1:
        return measurement
    posterior = candidates.posterior
    xi = log(inverse(measurement.T_target_lidar) @ posterior.T_target_lidar[rows])
    second_moment = np.einsum("c,cij->ij", weight[rows], posterior.covariance[rows] + xi[:, :, None] * xi[:, None, :])
    factor = max(1.0, float(np.trace(measurement.information() @ second_moment)) / 6.0)
    return TemplateMeasurement.from_stack(
        measurement.stack / np.sqrt(factor), measurement.n_rows, measurement.T_target_lidar
    )


def _explained(problem: Problem, geometry: EdgeGeometry, offset: float) -> float:
    """Share of edge points whose boundary is within the interval that a last return leaves, give or take 3 sigma."""
    along = geometry.along[0]
    boundary = geometry.residual[0] + offset * geometry.across[0] + along * problem.edges.middle
    half = np.abs(along) * 0.5 * problem.edges.width
    scatter = np.sqrt(own_variance(problem, geometry)[0] + (problem.edges.shift * along) ** 2)
    return float(np.mean(np.abs(boundary) < half + 3 * scatter))


def _verdict(
    explained: float, n_points: int, unobservable: tuple[str, ...], ambiguity: Ambiguity, fit: Fit
) -> tuple[Status, str]:
    """Status and reason."""
    if explained < MIN_EXPLAINED:
        count = round((1 - explained) * n_points)
        return (
            "failed",
            f"{count} of {n_points} ring ends do not end on an edge: not this target, or its returns are mixed",
        )
    if unobservable:
        return "failed", "not observable: " + "; ".join(unobservable)
    if fit.flags:
        return "doubtful", fit.reason
    if ambiguity.margin < AMBIGUITY_MARGIN:
        return "ambiguous", f"a different pose is only {ambiguity.margin:.2g} less likely (log likelihood)"
    return "ok", ""
