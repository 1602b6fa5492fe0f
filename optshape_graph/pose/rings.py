"""The door of scans with rings: which edge does each ring end on, and where is the target then?

Every consistent association of ring ends to edges gives a start (`association`); expectation propagation finds the
posterior of the pose about each (`propagation`); the starts are ranked and gathered in modes, and the best is compared
with the next (`modes`). What the best mode's associations say of the edges, and all returns of the plane, is compressed
into one measurement.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.edges import UP, EdgePoints, extract_edge_points, upward, with_top_and_bottom
from optshape_graph.factors.measurement import refine, template_rows
from optshape_graph.factors.static import (
    EDGE_OFFSET,
    ELEVATION,
    OUTER_EDGE,
    STRAIN,
    BiasedMeasurement,
    SharedError,
)
from optshape_graph.pose.association import enumerate_poses, fit_plane
from optshape_graph.pose.azimuth_grid import at_firing_times, level_rings, place_on_firings
from optshape_graph.pose.fit import Evidence
from optshape_graph.pose.modes import Modes, compare_modes, rank
from optshape_graph.pose.noise import EdgeNoise, one_scan, plane_measurement, returns_on_plane
from optshape_graph.pose.options import PoseOptions
from optshape_graph.pose.outline import Ends, fit_ends, strain_columns, tilt_of_rings
from optshape_graph.pose.propagation import EdgeGeometry, Problem, edge_geometry
from optshape_graph.pose.result import Ambiguity, Finding
from optshape_graph.pose.surface import PlaneResiduals, as_seen, displaced, find_surface
from optshape_graph.scan import Scan
from optshape_graph.se3 import difference, inverse
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target


def find_by_rings(scan: Scan, target: Target, options: PoseOptions) -> Finding:
    """Find a target's pose by the edges on which its rings end; see `estimate_pose`.

    Raises:
        EstimationError: the returns determine no pose at all.
    """
    # What was measured: ring ends on the grid of firings, and all returns against a plane near the target's.
    scan = at_firing_times(scan)
    levelled, angular_noise = level_rings(scan)
    edges = place_on_firings(extract_edge_points(levelled), levelled, angular_noise)
    assert scan.ring is not None
    ring, tilt, scan = scan.ring, tilt_of_rings(scan), levelled
    plane = fit_plane(scan.points, scan.ring)
    returns = returns_on_plane(scan, plane.axes[0], plane.distance, angular_noise, options)
    off_plane = PlaneResiduals.of(returns, plane, target, ring)
    shape = find_surface(off_plane)
    elevation_error = scan.sensor.elevation_error if scan.sensor else SensorModel.elevation_error
    seen = as_seen(returns, off_plane).with_elevations(plane.axes[0], ring[off_plane.usual], elevation_error)
    on_plane = plane_measurement(seen)
    bounded = edges if angular_noise else _bounded(edges, scan)
    problem = Problem(bounded, target, one_scan(on_plane).quadratic(), EdgeNoise.of(scan.sensor, options))

    # Every association, the posterior under each, and the best mode against the next.
    starts = _upright(enumerate_poses(edges, plane, target), target)
    modes = compare_modes(rank(problem, starts, scan, edges), problem, scan, edges)

    # The best mode in one measurement, at its minimum.
    best, n = modes.candidates.select(slice(0, 1)), len(edges)
    of_ends = replace(problem, edges=edges)
    ends = fit_ends(of_ends, best.T_target_lidar[0], best.geometry.labels[0, :n])
    on_edges, edge_weight = _edge_measurement(problem, modes, ends, elevation_error)
    shared = on_edges + on_plane
    exact = one_scan(shared)
    T_target_lidar = refine(exact)
    shared = _widened(displaced(shared, shape, off_plane, target, T_target_lidar), T_target_lidar, modes)
    measurement = one_scan(shared).at(T_target_lidar)

    # How the ring ends lie about the edges there.
    final = edge_geometry(problem, measurement.T_target_lidar[None], best.geometry.labels)
    return Finding(
        target=target,
        returns=scan,
        measurement=measurement,
        exact=exact,
        shared=shared,
        total_weight=edge_weight + float((1 / returns.sigma**2).sum()),
        ambiguity=Ambiguity(modes.margin, modes.rival),
        log_likelihood=modes.log_likelihood,
        edge_points=edges,
        labels=best.geometry.labels[0, :n],
        inset=best.inset[0, :n],
        edge_sigma=best.sigma[0, :n],
        edge_residuals=(final.residual[0] + best.inset[0] * final.along[0])[:n],
        evidence=Evidence(scan, of_ends, off_plane, shape, ends, angular_noise, tilt),
        objection=_objection(problem, final, float(best.offset[0]), options.min_explained),
    )


def _bounded(edges: EdgePoints, scan: Scan) -> EdgePoints:
    """Add that the target ends before the next ring: exact angles are taken for granted.

    Where rings in between are lost, the next one may be lost too. (With noisy azimuths a lone return of the outermost
    ring may lie beside the target.) Neither bounds anything.
    """
    complete = edges.n_rings == edges.ring[-1] - edges.ring[0] + 1
    return with_top_and_bottom(edges, scan) if complete else edges


def _upright(T: Floats, target: Target) -> Floats:
    """Turn poses (C, 4, 4) by the target's symmetries so that its z axis is as nearly up as it gets."""
    turned = inverse(target.symmetry_transforms) @ T[:, None]  # (T_lidar_target S)^-1 = S^-1 T_target_lidar
    return np.asarray(turned[np.arange(len(T)), turned[:, :, 2, 2].argmax(axis=1)])


def _edge_measurement(
    problem: Problem, modes: Modes, ends: Ends, elevation_error: float
) -> tuple[BiasedMeasurement, float]:
    """Boundary points against their edges, before what they share is marginalised; and their weight.

    They share the offset across the edges, and the strains of an outline that isn't as drawn, as large as are seen;
    those of a ring its elevation's error. Ends that scatter more than they should count less.

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
    rings, outside = np.unique(problem.edges.ring), np.abs(problem.edges.side) == UP
    rows, total = [], 0.0
    for k in np.flatnonzero(weight):
        one = posterior.select(slice(k, k + 1))
        geometry, sigma = one.geometry, one.sigma[0]
        boundary = problem.edges.points + one.inset[0][:, None] * problem.edges.outward(one.T_target_lidar[0, 0, :3])
        A, r = template_rows(
            boundary, geometry.direction[0], problem.target.offsets[geometry.labels[0]] + geometry.shift[0]
        )
        own, outer = _outer_edges(problem.edges, sigma, geometry.own[0])
        offset = geometry.across[0] * problem.noise.COMMON
        strains = ends.seen_strain * strain_columns(problem.target, geometry.labels[0], boundary, one.T_target_lidar[0])
        up = (geometry.direction[0] * (upward(boundary) @ one.T_target_lidar[0, :3, :3].T)).sum(axis=1)
        lifted = elevation_error * up[:, None] * (problem.edges.ring[:, None] == rings)
        whitened = np.column_stack([offset, strains, outer, lifted, A, r]) / (ends.factor * own[:, None])
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
            *(SharedError(ELEVATION, ring=int(ring)) for ring in rings),
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


def _without_shifts(B: Floats) -> Floats:
    """(M, M) matrix that whitens rows which unit-variance errors, columns B (M, K) of disjoint rows, share."""
    B = B[:, B.any(axis=0)]
    square = (B**2).sum(axis=0)
    return np.asarray(np.eye(len(B)) - (B * ((1 - 1 / np.sqrt(1 + square)) / square)) @ B.T)


def _widened(shared: BiasedMeasurement, T_target_lidar: Floats, modes: Modes) -> BiasedMeasurement:
    """Scale a measurement down where associations of the best mode disagree about the pose.

    The covariance of the mixture about the estimate, averaged over directions, is the measurement's own times a
    factor of at least 1.
    """
    weight, posterior = modes.weights, modes.candidates
    rows = np.flatnonzero(weight)
    if len(rows) == 1:
        return shared
    xi = difference(T_target_lidar, posterior.T_target_lidar[rows])
    second_moment = np.einsum("c,cij->ij", weight[rows], posterior.covariance[rows] + xi[:, :, None] * xi[:, None, :])
    factor = max(1.0, float(np.trace(one_scan(shared).information(T_target_lidar) @ second_moment)) / 6.0)
    return replace(shared, stack=shared.stack / np.sqrt(factor))


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
