"""What is known of one target in one scan: measured before its pose is, and found about its pose.

Every method begins with `measure` and ends with a `Finding`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.azimuth_grid import at_firing_times, level_rings, place_on_firings, tilt_of_rings
from optshape_graph.beam import Beam
from optshape_graph.chords import chords, sight_planes
from optshape_graph.edges import EdgePoints, edge_points, with_top_and_bottom
from optshape_graph.errors import EstimationError
from optshape_graph.factors.measurement import TemplateMeasurement
from optshape_graph.factors.plane_returns import PlaneReturns, elevation_bands, plane_measurement, returns_on_planes
from optshape_graph.factors.static import SURFACE, BiasedMeasurement, SharedError
from optshape_graph.groups import Groups
from optshape_graph.plane import ReturnsPlane, fit_planes
from optshape_graph.pose.ends import SEEN, EndsFit, Problem, RingEnds
from optshape_graph.pose.options import PoseOptions
from optshape_graph.pose.surface import PlaneResiduals, Sheets, Surface
from optshape_graph.ring_returns import RingReturns
from optshape_graph.scan import Scan, without_duplicates
from optshape_graph.se3 import adjoint, inverse
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

BANDS = (4, 16, 64, 256)
"""Into how many bands of elevation returns without rings are cut, at several scales, each band with a range bias."""

JUDGED = 64
"""Bands of elevation that stand for rings where the surface is judged."""

NARROWEST = 5e-3
"""Width that a beam counts as at least where returns outside are measured by it, metres: a board isn't cut truer."""


@dataclass(frozen=True, eq=False, repr=False)
class Evidence(Value):
    """What was measured, whatever the pose.

    Attributes:
        scan: the returns ring by ring and from the left, angles put right.
        problem: the template, both ends of each ring on the grid of firings (none without rings), and the plane.
        bounded: the same, and that the target ends before the next ring above and below; where angles are exact.
        plane: of the returns.
        returns: all returns against that plane, with the noise that the sensor file states.
        residuals: how they lie off it, and the noise and the biases that they show.
        surface: the shape in these distances.
        sheets: what they say of two revolutions.
        in_front: how many returns stand in front of the plane, and by how much, metres.
        missing_inside: firings between returns of a ring that returned nothing.
        on_plane: the returns of the plane, with noise and biases as large as they are seen, compressed.
        angular_noise: standard deviation of an angle, rad; 0 where angles are exact.
        tilt: how elevations vary with azimuth within rings, see `tilt_of_rings`; None without rings.
        duplicates: exact copies of returns that were dropped.
    """

    scan: Scan
    problem: Problem
    bounded: Problem
    plane: ReturnsPlane
    returns: PlaneReturns
    residuals: PlaneResiduals
    surface: Surface
    sheets: Sheets
    in_front: tuple[int, float]
    missing_inside: float
    on_plane: BiasedMeasurement
    angular_noise: float
    tilt: tuple[float, float] | None
    duplicates: int = 0

    def displaced(self, measurement: BiasedMeasurement, T_target_lidar: Floats) -> BiasedMeasurement:
        """Let the plane that was fitted lie off the target's own.

        A shape of rms e leaves the plane's distance open by 2 e, and its tilts by 2 e over the radius of gyration:
        which part of it was drawn as the plane nobody knows. The place in the plane goes with it, for rays keep their
        directions.

        Args:
            measurement: of the pose.
            T_target_lidar: (4, 4) where the measurement is at its minimum.
        """
        size, excess = self.surface.size, float(self.residuals.excess[0])
        if size + excess == 0:
            return measurement
        tilt = 2 * size / self.problem.target.gyration
        plane, within = [1, 2, 3], [0, 4, 5]  # turns about y and z and the shift along x; the rest
        Ad = adjoint(inverse(T_target_lidar))
        information = Ad.T @ measurement.of_one_scan().information(T_target_lidar) @ Ad
        effect = np.zeros((6, 3))
        effect[plane] = np.diag([tilt, tilt, np.hypot(2 * size, excess)])
        effect[within] = -np.linalg.solve(
            information[np.ix_(within, within)], information[np.ix_(within, plane)] @ effect[plane]
        )
        return measurement.displaced([SharedError(kind) for kind in SURFACE], effect, T_target_lidar)

    @cached_property
    def ranges(self) -> Floats:
        """(N,) of the returns, metres."""
        return np.asarray(np.linalg.norm(self.scan.points, axis=1))

    def reach(self, further: float) -> Floats:
        """(N,) how far outside the outline the returns may lie, metres: a beam, and three standard deviations.

        Args:
            further: azimuth by which the rings are seen to reach further, by blooming, rad.
        """
        beam = np.maximum(self.problem.beam.width(self.ranges), NARROWEST)
        return np.asarray(beam + (3 * self.angular_noise + further) * self.ranges)

    def outside(self, T_target_lidar: Floats, further: float = 0.0) -> tuple[Floats, Floats]:
        """How far the returns lie outside the outline at a pose (4, 4); negative inside.

        Returns:
            (N,) metres in the plane, where the rays meet it; and (N,) beam widths across the ray: seen at an angle, a
            beam reaches as much further in the plane.
        """
        target, t = self.problem.target, T_target_lidar[:3, 3]
        ray = self.scan.points @ T_target_lidar[:3, :3].T
        slope = ray[:, 1:] / ray[:, :1]
        beyond, mu = (t[1:] - t[0] * slope) @ target.normals.T - target.offsets, slope @ target.normals.T
        return beyond.max(axis=1), np.asarray((beyond / np.sqrt(1.0 + mu**2)).max(axis=1) / self.reach(further))


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
    counts, n_rings = returns.rings.counts, returns.rings_of_scan.counts
    residuals = PlaneResiduals.of(on_planes, planes, targets, counts, n_rings)
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
    gap = returns.azimuth - np.append(returns.azimuth[1:], 0.0)
    gap[returns.rings.last] = 0.0
    step = returns.scans.each(np.array([one.azimuth_step for one in edges]))
    missing: list[float] = returns.scans.sum(np.maximum(np.rint(gap / step) - 1, 0)).tolist()
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


def ends_of(evidences: Sequence[Evidence]) -> RingEnds:
    """Return the bounded ring ends of scans whose targets have as many edges, side by side."""
    problems = [evidence.bounded for evidence in evidences]
    return problems[0].ends if len(problems) == 1 else RingEnds.of(problems)


def _bounded(edges: EdgePoints, returns: RingReturns) -> EdgePoints:
    """Add that the target ends before the next ring: exact angles are taken for granted.

    Where rings in between are lost, the next one may be lost too. (With noisy azimuths a lone return of the outermost
    ring may lie beside the target.) Neither bounds anything.
    """
    complete = len(edges) > 0 and edges.n_rings == edges.ring[-1] - edges.ring[0] + 1
    return with_top_and_bottom(edges, returns) if complete else edges


@dataclass(frozen=True, eq=False, repr=False)
class Finding(Value):
    """What one of the methods finds in a scan: all that is judged and recorded.

    Attributes:
        evidence: what it was found in.
        measurement: all whitened residuals, compressed, taken at the pose that was found.
        exact: the same for a target without a surface of its own, which has its minimum there too: what is certified.
        shared: the same before the errors that scans of one static scene share are marginalised, or None.
        total_weight: sum over the residuals of 1 / sigma^2, 1/m2.
        margin: logarithm of the pose's probability over that of all different ones; infinite where there is none.
        rival: (4, 4) T_lidar_target of the likeliest different pose, or None.
        log_likelihood: logarithm of the evidence for the target at this pose, up to a constant of the scan.
        labels: (M,) edge of each ring end.
        inset: (M,) azimuth by which the boundary is taken to lie beyond each, rad.
        edge_sigma: (M,) standard deviation of each edge residual, metres.
        edge_residuals: (M,) distance of each boundary point from its edge, metres, positive outside.
        ends: ring ends against the outline; None without rings.
        mirrored: how much likelier the target's mirror image is, logarithm; 0 where that was not asked.
        objection: why the returns are not this target's, in words; empty where they are.
    """

    evidence: Evidence
    measurement: TemplateMeasurement
    exact: TemplateMeasurement
    shared: BiasedMeasurement | None
    total_weight: float
    margin: float
    rival: Floats | None
    log_likelihood: float
    labels: Ints
    inset: Floats
    edge_sigma: Floats
    edge_residuals: Floats
    ends: EndsFit | None
    mirrored: float = 0.0
    objection: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class Coverage(Value):
    """Where returns are lacking, against the outline.

    Attributes:
        missing_left: firings beyond the left ends of rings that should have returned and didn't.
        missing_right: the same beyond right ends.
        missing_rings: rings above and below those that returned whose chord holds two firings and more.
        expected: number of returns that the outline should have.
        cut: most neighbouring ends of one side at one azimuth where the outline isn't.
    """

    missing_left: float
    missing_right: float
    missing_rings: int
    expected: float
    cut: int


def coverage(evidences: Sequence[Evidence], T_target_lidar: Floats, further: Floats) -> list[Coverage]:
    """Count firings that are missing inside the outlines of scans whose targets have as many edges.

    Args:
        evidences: of B scans with rings.
        T_target_lidar: (B, 4, 4).
        further: (B,) azimuth by which the rings are seen to reach further, by blooming, rad.
    """
    ends, edges = ends_of(evidences), [evidence.problem.edges for evidence in evidences]
    rings, step = Groups(np.array([one.n_rings for one in edges])), ends.azimuth_step
    x, y, z = np.moveaxis(ends.points[:, : 2 * rings.counts.max() : 2], -1, 0)
    elevation = np.column_stack([np.arctan2(z, np.hypot(x, y)), ends.elevations])
    sides = sight_planes((ends.vertices - T_target_lidar[:, None, :3, 3]) @ T_target_lidar[:, :3, :3])
    right, left = chords(sides, elevation[:, None], ends.reference_azimuth[:, None])
    beside = (left - right)[:, rings.counts.max() :]
    mine = np.arange(elevation.shape[1]) < rings.counts[:, None]
    chord = np.column_stack([left[mine], -right[mine]])  # of the R rings, and both ends outwards
    at = np.concatenate([one.azimuth.reshape(-1, 2) for one in edges]) * [1.0, -1.0]
    # A ring that looks elsewhere than the table says ends elsewhere, far from there where it runs along the edge.
    geometry = ends.geometry(T_target_lidar)
    elsewhere = 2 * np.sqrt(geometry.of_ring) / np.maximum(np.abs(geometry.along), 1e-6)
    elsewhere = elsewhere[np.arange(elsewhere.shape[1]) < 2 * rings.counts[:, None]].reshape(-1, 2)
    reach = [np.median(one.reach(more) / one.ranges) for one, more in zip(evidences, further, strict=True)]
    slack = rings.each(step + np.array(reach))[:, None] + elsewhere

    missing = rings.sum(np.maximum(chord - at - slack, 0.0)) / step[:, None]
    length = np.maximum(chord.sum(axis=1), 0.0)
    expected = rings.sum(length * np.concatenate([one.revolutions[::2] for one in edges])) / step
    missing_rings = np.count_nonzero((beside > (2 * step + reach)[:, None]) & ends.silent, axis=1)
    odd = np.abs(chord - at) > rings.each(step)[:, None] + slack
    return [
        Coverage(
            missing_left=float(missing[k, 0]),
            missing_right=float(missing[k, 1]),
            missing_rings=int(missing_rings[k]),
            expected=float(expected[k]),
            cut=max(_at_one_azimuth(at[rows, side][odd[rows, side]], step[k]) for side in (0, 1)),
        )
        for k, rows in enumerate(rings.slices)
    ]


def _at_one_azimuth(azimuth: Floats, step: float) -> int:
    """Most of some ends of rings within 1.5 steps of azimuth."""
    odd = np.sort(azimuth)
    return int((np.searchsorted(odd, odd + 1.5 * step, side="right") - np.arange(len(odd))).max(initial=0))
