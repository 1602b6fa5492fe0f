"""Scans measured, whatever the poses: ring ends, planes, noise and shapes of many at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.azimuth_grid import at_firing_times, level_rings, place_on_firings, tilt_of_rings
from optshape_graph.beam import Beam
from optshape_graph.edges import EdgePoints, edge_points, with_top_and_bottom
from optshape_graph.errors import EstimationError
from optshape_graph.factors.plane_returns import PlaneReturns, elevation_bands, plane_measurement, returns_on_planes
from optshape_graph.plane import ReturnsPlane, fit_planes
from optshape_graph.pose.ends import SEEN, Problem
from optshape_graph.pose.evidence.records import Evidence
from optshape_graph.pose.evidence.residuals import PlaneResiduals
from optshape_graph.pose.options import PoseOptions
from optshape_graph.ring_returns import RingReturns
from optshape_graph.scan import Scan, without_duplicates
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

BANDS = (4, 16, 64, 256)
"""Into how many bands of elevation returns without rings are cut, at several scales, each band with a range bias."""

JUDGED = 64
"""Bands of elevation that stand for rings where the surface is judged."""


def measure(
    scans: Sequence[Scan], targets: Sequence[Target], options: PoseOptions, as_recorded: bool = False
) -> list[Evidence | EstimationError]:
    """Find both ends of each ring and the plane of the returns, with their noise, in B scans.

    Args:
        scans: (B,) the returns of one target each, corrected for what is known of their sensor's rings.
        targets: (B,) the templates.
        options: assumptions about both.
        as_recorded: leave the angles as they are, as the published method does.

    Returns:
        For each scan its evidence; or the error, where the returns span no plane, or no azimuth step is to be found.
    """
    found: dict[int, Evidence | EstimationError] = {
        k: EstimationError(f"{scan.name}: no returns on the target") for k, scan in enumerate(scans) if len(scan) == 0
    }
    for ringed in (True, False):
        chosen = [k for k, scan in enumerate(scans) if len(scan) and (scan.ring is not None) == ringed]
        for some in _chunks(chosen, [len(scan) for scan in scans]):
            once, duplicates = zip(*(without_duplicates(scans[k]) for k in some), strict=True)
            measured = _measure_together(once, [targets[k] for k in some], duplicates, options, as_recorded)
            found.update(zip(some, measured, strict=True))
    return [found[k] for k in range(len(scans))]


AT_ONCE = 40_000
"""Returns that are measured at once: arrays of so many rows stay in a processor's cache, and memory stays flat."""


def _chunks(chosen: Sequence[int], counts: Sequence[int]) -> Iterator[list[int]]:
    """Split scans in chunks of about AT_ONCE returns."""
    some: list[int] = []
    total = 0
    for k in chosen:
        if some and total + counts[k] > AT_ONCE:
            yield some
            some, total = [], 0
        some.append(k)
        total += counts[k]
    if some:
        yield some


def _measure_together(
    scans: Sequence[Scan],
    targets: Sequence[Target],
    duplicates: Sequence[int],
    options: PoseOptions,
    as_recorded: bool,
) -> list[Evidence | EstimationError]:
    """Measure scans that all have rings, or all have none, as `measure` does."""
    ringed = scans[0].ring is not None
    recorded = RingReturns.of(scans, None if ringed else [elevation_bands(scan.points, JUDGED) for scan in scans])
    returns, angular_noise = recorded, np.zeros(len(scans))
    if ringed and not as_recorded:
        recorded = at_firing_times(recorded)
        returns, angular_noise = level_rings(recorded)
    edges_or_not = edge_points(returns) if ringed else [EdgePoints.none()] * len(scans)
    weight = np.asarray(1.0 / (1.0 + returns.rings.counts) if ringed else np.ones(len(returns.rings)))
    planes_or_not = fit_planes(returns.points, returns.rings.each(weight), returns.scans)
    edges = [one for one in edges_or_not if isinstance(one, EdgePoints)]
    planes = [one for one in planes_or_not if isinstance(one, ReturnsPlane)]
    if min(len(edges), len(planes)) < len(scans):  # the others are measured without those that tell nothing
        failed = {
            k: one
            for ones in (planes_or_not, edges_or_not)
            for k, one in enumerate(ones)
            if isinstance(one, EstimationError)
        }
        good = [k for k in range(len(scans)) if k not in failed]
        kept = [scans[k] for k in good], [targets[k] for k in good], [duplicates[k] for k in good]
        others = iter(_measure_together(*kept, options, as_recorded) if good else [])
        return [failed[k] if k in failed else next(others) for k in range(len(scans))]

    # The returns against their planes, and what they show of noise, biases and shapes.
    ordered = returns.sorted_scans()
    normals, distances = np.array([plane.axes[0] for plane in planes]), np.array([plane.distance for plane in planes])
    on_planes = returns_on_planes(ordered, normals, distances, angular_noise, options.flatness)
    residuals = PlaneResiduals.of(on_planes, planes, targets, returns.layout)
    surfaces, sheets = residuals.surfaces(SEEN), residuals.sheets(returns.azimuth, returns.row)
    in_front = list(zip(*(part.tolist() for part in residuals.in_front()), strict=True))
    missing = _missing_inside(returns, edges) if ringed else [0.0] * len(scans)
    tilts = tilt_of_rings(recorded) if ringed else [None] * len(scans)
    apart = [residuals.of_scan(k) for k in range(len(scans))]
    measurements = [plane_measurement(_as_seen(*of)) for of in zip(on_planes, apart, ordered, normals, strict=True)]

    found: list[Evidence | EstimationError] = []
    for k, (scan, target, noise) in enumerate(zip(ordered, targets, angular_noise.tolist(), strict=True)):
        ends, sensor, own = edges[k], scan.sensor, returns.of_scan(k)
        if noise:
            ends = place_on_firings(ends, own, noise)
        problem = Problem(ends, target, measurements[k].of_one_scan().quadratic(), Beam.of(sensor), options, sensor)
        bounded = problem if noise or not ringed else replace(problem, edges=_bounded(ends, own))
        found.append(
            Evidence(
                scan, problem, bounded, planes[k], on_planes[k], apart[k], surfaces[k], sheets[k], in_front[k],
                missing[k], measurements[k], noise, tilts[k], duplicates[k],
            )
        )  # fmt: skip
    return found


def _missing_inside(returns: RingReturns, edges: Sequence[EdgePoints]) -> list[float]:
    """Count firings between the returns of rings that returned nothing, in B scans."""
    step = returns.scans.each(np.array([one.azimuth_step for one in edges]))
    missing: list[float] = returns.scans.sum(np.maximum(np.rint(returns.gap / step) - 1, 0)).tolist()
    return missing


def _as_seen(returns: PlaneReturns, residuals: PlaneResiduals, scan: Scan, normal: Floats) -> PlaneReturns:
    """Return what is of the plane, noise and biases as large as they are seen, with all errors that returns share."""
    noise, bias = (residuals.noise / residuals.file_noise)[0], (residuals.bias / residuals.file_bias)[0]
    brightness_bias = scan.sensor.brightness_bias if scan.sensor else SensorModel.brightness_bias
    if scan.ring is None:
        seen = returns.with_bands(scan.points, BANDS).widened(noise, bias).select(residuals.usual)
    else:
        seen = returns.widened(noise, bias).select(residuals.usual)
        seen = seen.with_angles(normal, scan.ring[residuals.usual], scan.sensor)
    return seen.with_brightness(normal, brightness_bias)


def _bounded(edges: EdgePoints, returns: RingReturns) -> EdgePoints:
    """Add that the target ends before the next ring: exact angles are taken for granted.

    Where rings in between are lost, the next one may be lost too. (With noisy azimuths a lone return of the outermost
    ring may lie beside the target.) Neither bounds anything.
    """
    complete = len(edges) > 0 and edges.n_rings == edges.ring[-1] - edges.ring[0] + 1
    return with_top_and_bottom(edges, returns) if complete else edges
