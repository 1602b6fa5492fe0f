"""The door of scans with rings: which edge does each ring end on, and where is the target then?

Every consistent association of ring ends to edges gives a start (`association`); expectation propagation finds the
posterior of the pose about each (`propagation`); the starts are ranked and gathered in modes, and the best is compared
with the next (`modes`). What the best mode's associations say of the edges, and all returns of the plane, is compressed
into one measurement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.edges import UP, EdgePoints
from optshape_graph.errors import EstimationError
from optshape_graph.factors.measurement import refine, template_rows
from optshape_graph.factors.static import (
    BLOOMING,
    EDGE_OFFSET,
    OUTER_EDGE,
    STRAIN,
    BiasedMeasurement,
    SharedError,
    angle_errors,
)
from optshape_graph.pose.evidence import Evidence, Finding
from optshape_graph.pose.modes import Modes, SampledPose, compare_modes, find_candidates
from optshape_graph.se3 import difference, vec, vec_derivative

MOST = 0.5
"""Share of a sampled pose's variance, in any direction, that errors which scans share explain at most: by how far they
displace the pose differs a little from scan to scan, and where little is left that difference would tell the errors."""


def find_by_rings(evidences: Sequence[Evidence]) -> list[Finding | EstimationError]:
    """Find targets' poses by the edges on which their rings end; see `estimate_poses`.

    Args:
        evidences: of B scans with rings, the candidates of all of which are worked out at once.

    Returns:
        For each scan what was found; or the error, where no pose explains the returns.
    """
    found: list[Finding | EstimationError] = []
    for evidence, candidates in zip(evidences, find_candidates(evidences), strict=True):
        try:
            found.append(_in_one_measurement(evidence, compare_modes(candidates, evidence)))
        except EstimationError as error:
            found.append(error)
    return found


def _in_one_measurement(evidence: Evidence, modes: Modes) -> Finding:
    """Compress the best mode into one measurement, taken at its minimum."""
    problem, on_plane, n = evidence.bounded, evidence.on_plane, len(evidence.problem.edges)
    best = modes.candidates
    T, labels, offset = best.T_target_lidar[:1], best.geometry.labels[:1], float(best.offset[0])
    if modes.sampled is not None:
        T, offset = modes.sampled.T_target_lidar[None], modes.sampled.offset
        labels = problem.geometry(T).labels
    ends = evidence.problem.fit(T[0], labels[0, :n])
    if modes.sampled is None:
        on_edges, edge_weight = _edge_measurement(evidence, modes, ends.seen_strain, ends.factor)
        shared = on_edges + on_plane
    else:
        offset_sd = problem.beam.offset_of_rays(np.linalg.norm(problem.edges.points, axis=1))
        shared, edge_weight = sampled_measurement(modes.sampled, on_plane, offset_sd)

    # What is uncertain beside: the surface, and associations that disagree or ends that scatter more than they should.
    T_target_lidar = refine(shared.of_one_scan().at(T[0]))
    if modes.sampled is None:
        factor = _disagreement(evidence.displaced(shared, T_target_lidar), T_target_lidar, modes)
    else:
        factor = ends.factor
    shared = replace(shared, stack=shared.stack / factor)
    exact = shared.of_one_scan().at(T_target_lidar)  # shared errors weigh otherwise now: its minimum is its own
    T_target_lidar = refine(exact)
    shared = evidence.displaced(shared, T_target_lidar)

    # How the ring ends lie about the edges there.
    final = problem.geometry(T_target_lidar[None], labels)
    return Finding(
        evidence=evidence,
        measurement=shared.of_one_scan().at(T_target_lidar),
        exact=exact,
        shared=shared,
        total_weight=edge_weight + float((1 / evidence.returns.sigma**2).sum()),
        margin=modes.margin,
        rival=modes.rival,
        log_likelihood=modes.log_likelihood,
        labels=final.labels[0, :n],
        inset=best.inset[0, :n],
        edge_sigma=best.sigma[0, :n],
        edge_residuals=(final.residual[0] + best.inset[0] * final.along[0])[:n],
        ends=ends,
        objection=_objection(evidence, T_target_lidar, labels, offset),
    )


def _edge_measurement(
    evidence: Evidence, modes: Modes, strain: float, factor: float
) -> tuple[BiasedMeasurement, float]:
    """Boundary points against their edges, before what they share is marginalised; and their weight.

    They share the offset across the edges, the blooming, and the strains of an outline that isn't as drawn, as large as
    are seen; those of a ring the errors of its elevation and of its azimuth. Ends that scatter more than they should
    count less.

    Near a vertex a ring end may belong to either edge, so associations of the best mode that are nearly as likely
    take part: a weighted mean of their costs is a cost of the same form. Its minimum is near the mixture's mean where
    a weight is the association's probability over how sure that association is of its pose, against the others.

    Args:
        evidence: of the scan.
        modes: what was found in it.
        strain: of the outline, as far as it is seen.
        factor: on standard deviations of ring ends.

    Returns:
        The measurement, and the sum of 1 / sigma^2, 1/m2.
    """
    problem, weight, posterior = evidence.bounded, modes.weights, modes.candidates
    covariance = posterior.covariance
    mean = np.einsum("c,cij->ij", weight, covariance)
    weight = weight / np.trace(np.linalg.solve(covariance, mean), axis1=1, axis2=2)
    weight /= weight.sum()
    chosen = np.flatnonzero(weight)  # A of them, M edge points each
    weight, T, edges = weight[chosen], posterior.T_target_lidar[chosen], problem.edges
    g, inset, sigma = posterior.geometry.select(chosen), posterior.inset[chosen], posterior.sigma[chosen]
    normal = T[:, 0, :3, None]
    outward = edges.sweep - edges.points * ((edges.sweep @ normal) / (edges.points @ normal))
    boundary = edges.points + inset[..., None] * outward
    offsets = problem.target.offsets[g.labels] + g.shift
    A, r = template_rows(boundary.reshape(-1, 3), g.direction.reshape(-1, 3), offsets.ravel())
    sigma = np.sqrt(np.maximum(sigma**2 - g.of_ring, 0.1 * sigma**2))
    own, outer = _outer_edges(edges, sigma, g.own - g.of_ring)
    ring = np.tile(edges.ring, len(chosen))
    by_angle, angles = angle_errors(g.lifted.ravel(), g.turned.ravel(), ring, problem.sensor)
    common = np.stack([g.across * problem.beam.common, -g.along * problem.blooming[:, 0]], axis=-1)
    parts = [common, strain * problem.strains(g.labels, boundary, T), outer, by_angle, A, r]
    rows = np.concatenate([part.reshape(*own.shape, -1) for part in parts], axis=-1)
    rows *= (np.sqrt(weight)[:, None] / (factor * own))[..., None]
    if problem.ring_shifts.shape[1]:
        rows = _without_shifts(problem.ring_shifts * (g.along / own)[..., None], rows)
    stack = rows.reshape(-1, rows.shape[-1])
    measurement = BiasedMeasurement.from_rows(
        stack[:, -13:-1],
        stack[:, :-13],
        stack[:, -1],
        posterior.T_target_lidar[0],
        [
            *(SharedError(kind) for kind in (EDGE_OFFSET, BLOOMING, *STRAIN)),
            *(SharedError(OUTER_EDGE, ring=int(ring)) for ring in edges.ring[np.abs(edges.side) == UP]),
            *angles,
        ],
    )
    total = float(weight @ (1 / (factor * sigma) ** 2).sum(axis=1))
    return replace(measurement, n_rows=len(edges)), total


def _outer_edges(edges: EdgePoints, sigma: Floats, own: Floats) -> tuple[Floats, Floats]:
    """Split what is known of where the target ends before the next ring, the same in all scans of a static scene.

    Args:
        edges: ring ends, and returns of the highest and the lowest ring.
        sigma: (A, M) standard deviation of each, metres.
        own: (A, M) variance that each scan draws anew, square metres.

    Returns:
        (A, M) the part of the standard deviations that is drawn anew, and (A, M, K) the part that is shared.
    """
    outside = np.abs(edges.side) == UP
    new = np.where(outside, np.sqrt(np.clip(own, 1e-2 * sigma**2, sigma**2)), sigma)
    shared = np.sqrt(np.maximum(sigma**2 - new**2, 0.0))
    return new, shared[..., None] * np.eye(len(edges))[:, outside]


def sampled_measurement(
    sampled: SampledPose, on_plane: BiasedMeasurement, offset_sd: float
) -> tuple[BiasedMeasurement, float]:
    """Say of a pose that was sampled what the plane and the edges say together.

    To samples, what scans of one sensor or scene share is a blur. Each such error becomes a column of its own, which
    displaces pose and offset, and its part is taken out of the blur.

    Args:
        sampled: pose and offset.
        on_plane: what the returns of the plane say.
        offset_sd: standard deviation of the offset before the scan, in beam widths.

    Returns:
        The measurement of plane and edges, and the sum of 1 / sigma^2 of the edges, 1/m2.
    """
    T, root = sampled.T_target_lidar, np.linalg.cholesky(sampled.covariance)
    directions, size, errors = np.linalg.svd(np.linalg.solve(root, sampled.effect), full_matrices=False)
    effect = root @ (directions * np.minimum(size, np.sqrt(MOST))) @ errors
    blur = replace(sampled, covariance=sampled.covariance - effect @ effect.T)
    on_edges, weight = _blurred_measurement(blur, on_plane, offset_sd)
    shared = on_edges + on_plane
    k = len(shared.shared)
    columns = {error: shared.stack[:, i] for i, error in enumerate(shared.shared)}
    A = shared.stack[:, k:-1]
    J = np.column_stack([A @ vec_derivative(T), columns[SharedError(EDGE_OFFSET)] / offset_sd])
    for error, moved in zip(sampled.errors, -(J @ effect).T, strict=True):
        columns[error] = columns.get(error, 0.0) + moved
    B = np.column_stack(list(columns.values()))
    measurement = BiasedMeasurement.from_rows(A, B, shared.stack[:, -1], T, list(columns))
    return replace(measurement, n_rows=shared.n_rows), weight


def _blurred_measurement(
    sampled: SampledPose, on_plane: BiasedMeasurement, offset_sd: float
) -> tuple[BiasedMeasurement, float]:
    """Say of the edges what, with the plane, makes the pose that was sampled, its covariance and the offset's.

    Near the mean (R0, t0) a right perturbation (w, v) is linear in z = [vec R; t]: w is half of what is skew in
    R0^T R, and v = R0^T (t - t0). w vanishes for a half turn too; two rows of second order, the diagonal of R0^T R less
    1, tell that apart.

    Args:
        sampled: pose and offset.
        on_plane: what the returns of the plane say.
        offset_sd: standard deviation of the offset before the scan, in beam widths.

    Returns:
        The measurement, in z and the common offset, and the sum of 1 / sigma^2, 1/m2.
    """
    T = sampled.T_target_lidar
    scale = np.append(np.ones(6), offset_sd)
    total = np.linalg.inv(sampled.covariance) * np.outer(scale, scale)
    elsewhere, pull = np.zeros((7, 7)), np.zeros(7)  # of the plane, and of the offset's prior
    plane = on_plane.of_one_scan().at(T)
    J = plane.jacobian(T)
    elsewhere[:6, :6], elsewhere[6, 6] = J.T @ J, 1.0
    pull[:6], pull[6] = J.T @ plane.residual(T), sampled.offset / offset_sd
    # What is left is the edges'. Where samples scatter more than the plane alone would let them, almost nothing is.
    root = np.linalg.cholesky(total)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, total - elsewhere).T))
    values = np.maximum(values, 1e-3)
    whiten = np.sqrt(values)[:, None] * (root @ vectors).T
    constant = whiten @ np.append(np.zeros(6), -sampled.offset / offset_sd) - np.linalg.solve(whiten.T, pull)
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


def _without_shifts(B: Floats, rows: Floats) -> Floats:
    """Whiten rows (A, M, n) which unit-variance errors share, columns B (A, M, K) of disjoint rows."""
    square = (B**2).sum(axis=1, keepdims=True)
    share = np.where(square > 0, (1 - 1 / np.sqrt(1 + square)) / np.maximum(square, 1e-300), 0.0)
    return np.asarray(rows - (B * share) @ (np.swapaxes(B, 1, 2) @ rows))


def _disagreement(shared: BiasedMeasurement, T_target_lidar: Floats, modes: Modes) -> float:
    """Return the factor on standard deviations by which associations of the best mode disagree about the pose.

    The covariance of the mixture about the estimate, averaged over directions, is the measurement's own times
    the square of a factor of at least 1.
    """
    weight, posterior = modes.weights, modes.candidates
    rows = np.flatnonzero(weight)
    if len(rows) == 1:
        return 1.0
    xi = difference(T_target_lidar, posterior.T_target_lidar[rows])
    second_moment = np.einsum("c,cij->ij", weight[rows], posterior.covariance[rows] + xi[:, :, None] * xi[:, None, :])
    return float(np.sqrt(max(1.0, np.trace(shared.of_one_scan().information(T_target_lidar) @ second_moment) / 6.0)))


def _objection(evidence: Evidence, T_target_lidar: Floats, labels: Ints, offset: float) -> str:
    """Say how many ring ends lie elsewhere than a last return may, give or take 3 sigma, where those are too many."""
    problem, edges = evidence.bounded, evidence.bounded.edges
    geometry = problem.geometry(T_target_lidar[None], labels)
    along = geometry.along[0]
    boundary = geometry.residual[0] + offset * geometry.across[0] + along * edges.middle
    half = np.abs(along) * 0.5 * edges.width
    scatter = np.sqrt(geometry.own[0] + (edges.shift * along) ** 2)
    explained = np.abs(boundary) < half + 3 * scatter
    if explained.mean() >= problem.options.min_explained:
        return ""
    count = f"{(~explained).sum()} of {len(explained)}"
    return f"{count} ring ends do not end on an edge: not this target, or its returns are mixed"
