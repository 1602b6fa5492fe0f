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
from optshape_graph.edges import UP, EdgePoints, extract_edge_points, with_top_and_bottom
from optshape_graph.factors.measurement import refine, template_rows
from optshape_graph.factors.static import (
    EDGE_OFFSET,
    OUTER_EDGE,
    STRAIN,
    BiasedMeasurement,
    SharedError,
)
from optshape_graph.pose.association import ReturnsPlane, enumerate_poses, fit_plane
from optshape_graph.pose.azimuth_grid import at_firing_times, level_rings, place_on_firings
from optshape_graph.pose.fit import Evidence
from optshape_graph.pose.modes import Modes, SampledPose, compare_modes, rank
from optshape_graph.pose.noise import (
    EdgeNoise,
    PlaneReturns,
    angle_errors,
    one_scan,
    plane_measurement,
    returns_on_plane,
)
from optshape_graph.pose.options import PoseOptions
from optshape_graph.pose.outline import Ends, fit_ends, strain_columns, tilt_of_rings
from optshape_graph.pose.propagation import EdgeGeometry, Posterior, Problem, edge_geometry
from optshape_graph.pose.result import Ambiguity, Finding
from optshape_graph.pose.surface import PlaneResiduals, Surface, as_seen, displaced, find_surface
from optshape_graph.scan import Scan
from optshape_graph.se3 import difference, vec, vec_derivative
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class Measured(Value):
    """What was measured, whatever the pose.

    Attributes:
        scan: the returns, angles put right.
        angular_noise: standard deviation of an angle, rad; 0 where angles are exact.
        tilt: how elevations vary with azimuth within rings, see `tilt_of_rings`.
        edges: both ends of each ring, on the grid of firings.
        plane: of the returns.
        returns: all returns against a plane near the target's, with the noise that the sensor file states.
        off_plane: how they lie off it, and the noise and the biases that they show.
        surface: the shape in these distances.
        on_plane: the returns of the plane, with noise and biases as large as they are seen, compressed.
        problem: the target in this scan.
    """

    scan: Scan
    angular_noise: float
    tilt: tuple[float, float]
    edges: EdgePoints
    plane: ReturnsPlane
    returns: PlaneReturns
    off_plane: PlaneResiduals
    surface: Surface
    on_plane: BiasedMeasurement
    problem: Problem


def measure(scan: Scan, target: Target, options: PoseOptions) -> Measured:
    """Find both ends of each ring and the plane of the returns, with their noise.

    Raises:
        EstimationError: the returns span no plane, or no azimuth step is to be found.
    """
    scan = at_firing_times(scan)
    assert scan.ring is not None
    ring, as_recorded = scan.ring, scan
    scan, angular_noise = level_rings(scan)
    edges = place_on_firings(extract_edge_points(scan), scan, angular_noise)
    plane = fit_plane(scan.points, ring)
    returns = returns_on_plane(scan, plane.axes[0], plane.distance, angular_noise, options)
    off_plane = PlaneResiduals.of(returns, plane, target, ring)
    noise = EdgeNoise.of(scan.sensor, options)
    seen = as_seen(returns, off_plane).with_angles(plane.axes[0], ring[off_plane.usual], noise)
    on_plane = plane_measurement(seen)
    bounded = edges if angular_noise else _bounded(edges, scan)
    problem = Problem(bounded, target, one_scan(on_plane).quadratic(), noise)
    surface, tilt = find_surface(off_plane), tilt_of_rings(as_recorded)
    return Measured(scan, angular_noise, tilt, edges, plane, returns, off_plane, surface, on_plane, problem)


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
    T, labels, offset = best.T_target_lidar, best.geometry.labels, float(best.offset[0])
    if modes.sampled is not None:
        T, offset = modes.sampled.T_target_lidar[None], modes.sampled.offset
        labels = edge_geometry(problem, T).labels
    of_ends = replace(problem, edges=edges)
    ends = fit_ends(of_ends, T[0], labels[0, :n])
    if modes.sampled is None:
        on_edges, edge_weight = _edge_measurement(problem, modes, ends)
    else:
        on_edges, edge_weight = sampled_measurement(modes.sampled, on_plane, problem.noise.common)
    shared = on_edges + on_plane

    # What is uncertain beside: the surface, and associations that disagree or ends that scatter more than they should.
    def displace(shared: BiasedMeasurement, T_target_lidar: Floats) -> BiasedMeasurement:
        return displaced(shared, measured.surface, measured.off_plane, target, T_target_lidar)

    T_target_lidar = refine(one_scan(shared).at(T[0]))
    if modes.sampled is None:
        factor = _disagreement(displace(shared, T_target_lidar), T_target_lidar, modes)
    else:
        factor = ends.factor
    shared = replace(shared, stack=shared.stack / factor)
    exact = one_scan(shared).at(T_target_lidar)  # errors that are shared weigh otherwise now: its minimum is its own
    T_target_lidar = refine(exact)
    shared = displace(shared, T_target_lidar)

    # How the ring ends lie about the edges there.
    final = edge_geometry(problem, T_target_lidar[None], labels)
    return Finding(
        target=target,
        returns=scan,
        measurement=one_scan(shared).at(T_target_lidar),
        exact=exact,
        shared=shared,
        total_weight=edge_weight + float((1 / measured.returns.sigma**2).sum()),
        ambiguity=Ambiguity(modes.margin, modes.rival),
        log_likelihood=modes.log_likelihood,
        edge_points=edges,
        labels=final.labels[0, :n],
        inset=best.inset[0, :n],
        edge_sigma=best.sigma[0, :n],
        edge_residuals=(final.residual[0] + best.inset[0] * final.along[0])[:n],
        evidence=Evidence(
            scan, of_ends, measured.off_plane, measured.surface, ends, measured.angular_noise, measured.tilt
        ),
        objection=_objection(problem, final, offset, options.min_explained),
    )


def _bounded(edges: EdgePoints, scan: Scan) -> EdgePoints:
    """Add that the target ends before the next ring: exact angles are taken for granted.

    Where rings in between are lost, the next one may be lost too. (With noisy azimuths a lone return of the outermost
    ring may lie beside the target.) Neither bounds anything.
    """
    complete = edges.n_rings == edges.ring[-1] - edges.ring[0] + 1
    return with_top_and_bottom(edges, scan) if complete else edges


def _edge_measurement(problem: Problem, modes: Modes, ends: Ends) -> tuple[BiasedMeasurement, float]:
    """Boundary points against their edges, before what they share is marginalised; and their weight.

    They share the offset across the edges, and the strains of an outline that isn't as drawn, as large as are seen;
    those of a ring the errors of its elevation and of its azimuth. Ends that scatter more than they should count less.

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
    outside = np.abs(problem.edges.side) == UP
    rows, total = [], 0.0
    for k in np.flatnonzero(weight):
        one = posterior.select(slice(k, k + 1))
        geometry, sigma = one.geometry, one.sigma[0]
        boundary = problem.edges.points + one.inset[0][:, None] * problem.edges.outward(one.T_target_lidar[0, 0, :3])
        A, r = template_rows(
            boundary, geometry.direction[0], problem.target.offsets[geometry.labels[0]] + geometry.shift[0]
        )
        of_ring = geometry.lifted[0] ** 2 + geometry.turned[0] ** 2
        sigma = np.sqrt(np.maximum(sigma**2 - of_ring, 0.1 * sigma**2))
        own, outer = _outer_edges(problem.edges, sigma, geometry.own[0] - of_ring)
        offset = geometry.across[0] * problem.noise.common
        strains = ends.seen_strain * strain_columns(problem.target, geometry.labels[0], boundary, one.T_target_lidar[0])
        by_angle, angles = angle_errors(geometry.lifted[0], geometry.turned[0], problem.edges.ring)
        whitened = np.column_stack([offset, strains, outer, by_angle, A, r]) / (ends.factor * own[:, None])
        shifts = _without_shifts(problem.ring_shifts * (geometry.along[0] / own)[:, None])
        rows.append(np.sqrt(weight[k]) * shifts @ whitened)
        total += float(weight[k] * (1 / (ends.factor * sigma) ** 2).sum())
    stack = np.vstack(rows)
    measurement = BiasedMeasurement.from_rows(
        stack[:, -13:-1],
        stack[:, :-13],
        stack[:, -1],
        posterior.T_target_lidar[0],
        [
            *(SharedError(kind) for kind in (EDGE_OFFSET, *STRAIN)),
            *(SharedError(OUTER_EDGE, ring=int(ring)) for ring in problem.edges.ring[outside]),
            *angles,
        ],
    )
    return replace(measurement, n_rows=len(problem.edges)), total


def _outer_edges(edges: EdgePoints, sigma: Floats, own: Floats) -> tuple[Floats, Floats]:
    """Split what is known of where the target ends before the next ring, the same in all scans of a static scene.

    Args:
        edges: ring ends, and returns of the highest and the lowest ring.
        sigma: (M,) standard deviation of each, metres.
        own: (M,) variance that each scan draws anew, square metres.

    Returns:
        (M,) the part of the standard deviations that is drawn anew, and (M, K) the part that is shared.
    """
    outside = np.abs(edges.side) == UP
    new = np.where(outside, np.sqrt(np.clip(own, 1e-2 * sigma**2, sigma**2)), sigma)
    return new, (np.eye(len(sigma)) * np.sqrt(np.maximum(sigma**2 - new**2, 0.0)))[:, outside]


def sampled_measurement(
    sampled: SampledPose, on_plane: BiasedMeasurement, common: float
) -> tuple[BiasedMeasurement, float]:
    """Say of the edges what, with the plane, makes the pose that was sampled, its covariance and the offset's.

    Near the mean (R0, t0) a right perturbation (w, v) is linear in z = [vec R; t]: w is half of what is skew in
    R0^T R, and v = R0^T (t - t0). w vanishes for a half turn too; two rows of second order, the diagonal of R0^T R less
    1, tell that apart.

    Returns:
        The measurement, in z and the common offset, and the sum of 1 / sigma^2, 1/m2.
    """
    T = sampled.T_target_lidar
    scale = np.append(np.ones(6), common)
    total = np.linalg.inv(sampled.covariance) * np.outer(scale, scale)
    elsewhere, pull = np.zeros((7, 7)), np.zeros(7)  # of the plane, and of the offset's prior
    plane = one_scan(on_plane).at(T)
    J = plane.jacobian(T)
    elsewhere[:6, :6], elsewhere[6, 6] = J.T @ J, 1.0
    pull[:6], pull[6] = J.T @ plane.residual(T), sampled.offset / common
    # What is left is the edges'. Where samples scatter more than the plane alone would let them, almost nothing is.
    root = np.linalg.cholesky(total)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, total - elsewhere).T))
    values = np.maximum(values, 1e-3)
    whiten = np.sqrt(values)[:, None] * (root @ vectors).T
    constant = whiten @ np.append(np.zeros(6), -sampled.offset / common) - np.linalg.solve(whiten.T, pull)
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
    return float(np.sqrt(max(1.0, np.trace(one_scan(shared).information(T_target_lidar) @ second_moment) / 6.0)))


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
