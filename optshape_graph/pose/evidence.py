"""What is known of one target in one scan: measured before its pose is, and found about its pose.

Every method begins with `measure` and ends with a `Finding`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.azimuth_grid import at_firing_times, level_rings, place_on_firings, tilt_of_rings
from optshape_graph.beam import Beam
from optshape_graph.chords import chords, sight_planes
from optshape_graph.edges import EdgePoints, extract_edge_points, relative_azimuth, with_top_and_bottom
from optshape_graph.factors.measurement import TemplateMeasurement
from optshape_graph.factors.plane_returns import PlaneReturns, elevation_bands, plane_measurement, returns_on_plane
from optshape_graph.factors.static import SURFACE, BiasedMeasurement, SharedError
from optshape_graph.plane import ReturnsPlane, fit_plane
from optshape_graph.pose.ends import SEEN, EndsFit, Problem, RingEnds
from optshape_graph.pose.options import PoseOptions
from optshape_graph.pose.surface import PlaneResiduals, Surface
from optshape_graph.scan import Scan
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
        scan: the returns, angles put right.
        problem: the template, both ends of each ring on the grid of firings (none without rings), and the plane.
        bounded: the same, and that the target ends before the next ring above and below; where angles are exact.
        plane: of the returns.
        returns: all returns against that plane, with the noise that the sensor file states.
        residuals: how they lie off it, and the noise and the biases that they show.
        surface: the shape in these distances.
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
        size, excess = self.surface.size, self.residuals.excess
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

    def in_plane(self, T_target_lidar: Floats) -> Floats:
        """(N, 2) y and z of where the rays of the returns meet the target's plane at a pose (4, 4), metres."""
        points, R, t = self.scan.points, T_target_lidar[:3, :3], T_target_lidar[:3, 3]
        met = points * (-t[0] / (points @ R[0]))[:, None]
        return np.asarray(met @ R[1:].T + t[1:])

    def reach(self, further: float) -> Floats:
        """(N,) how far outside the outline the returns may lie, metres: a beam, and three standard deviations.

        Args:
            further: azimuth by which the rings are seen to reach further, by blooming, rad.
        """
        ranges = np.linalg.norm(self.scan.points, axis=1)
        beam = np.maximum(self.problem.beam.width(ranges), NARROWEST)
        return np.asarray(beam + (3 * self.angular_noise + further) * ranges)

    def outside_beams(self, T_target_lidar: Floats, further: float = 0.0) -> Floats:
        """(N,) how far the returns lie outside the outline at a pose (4, 4), in beam widths; negative inside.

        Across the ray: seen at an angle, a beam reaches as much further in the plane.
        """
        target, ray = self.problem.target, self.scan.points @ T_target_lidar[:3, :3].T
        mu = (ray[:, 1:] / ray[:, :1]) @ target.normals.T
        beyond = self.in_plane(T_target_lidar) @ target.normals.T - target.offsets
        return np.asarray((beyond / np.sqrt(1.0 + mu**2)).max(axis=1) / self.reach(further))


def measure(
    scan: Scan, target: Target, options: PoseOptions, duplicates: int = 0, as_recorded: bool = False
) -> Evidence:
    """Find both ends of each ring and the plane of the returns, with their noise.

    Args:
        scan: the returns of one target.
        target: the template.
        options: assumptions about both.
        duplicates: exact copies of returns that were dropped.
        as_recorded: leave the angles as they are, as the published method does.

    Raises:
        EstimationError: the returns span no plane, or no azimuth step is to be found.
    """
    angular_noise, tilt, edges = 0.0, None, EdgePoints.none()
    if scan.ring is not None:
        recorded = scan if as_recorded else at_firing_times(scan)
        if not as_recorded:
            scan, angular_noise = level_rings(recorded)
        edges, tilt = place_on_firings(extract_edge_points(scan), scan, angular_noise), tilt_of_rings(recorded)
    plane = fit_plane(scan.points, scan.ring)
    returns = returns_on_plane(scan, plane.axes[0], plane.distance, angular_noise, options.flatness)
    ring = elevation_bands(scan.points, JUDGED) if scan.ring is None else scan.ring
    residuals = PlaneResiduals.of(returns, plane, target, ring)
    if scan.ring is None:
        seen = residuals.as_seen(returns.with_bands(scan.points, BANDS))
    else:
        seen = residuals.as_seen(returns).with_angles(plane.axes[0], ring[residuals.usual], scan.sensor)
    brightness_bias = scan.sensor.brightness_bias if scan.sensor else SensorModel.brightness_bias
    on_plane = plane_measurement(seen.with_brightness(plane.axes[0], brightness_bias))
    problem = Problem(edges, target, on_plane.of_one_scan().quadratic(), Beam.of(scan.sensor), options, scan.sensor)
    bounded = problem if angular_noise else replace(problem, edges=_bounded(edges, scan))
    surface = residuals.surface(SEEN)
    return Evidence(
        scan, problem, bounded, plane, returns, residuals, surface, on_plane, angular_noise, tilt, duplicates
    )


def ends_of(evidences: Sequence[Evidence]) -> RingEnds:
    """Return the bounded ring ends of scans whose targets have as many edges, side by side."""
    problems = [evidence.bounded for evidence in evidences]
    return problems[0].ends if len(problems) == 1 else RingEnds.of(problems)


def _bounded(edges: EdgePoints, scan: Scan) -> EdgePoints:
    """Add that the target ends before the next ring: exact angles are taken for granted.

    Where rings in between are lost, the next one may be lost too. (With noisy azimuths a lone return of the outermost
    ring may lie beside the target.) Neither bounds anything.
    """
    complete = len(edges) > 0 and edges.n_rings == edges.ring[-1] - edges.ring[0] + 1
    return with_top_and_bottom(edges, scan) if complete else edges


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
    """Where the returns are and are not, against the outline.

    Attributes:
        outside: (N,) how far each return lies outside the outline, in beam widths; negative inside.
        missing_left: firings beyond the left ends of rings that should have returned and didn't.
        missing_right: the same beyond right ends.
        missing_inside: between returns.
        missing_rings: rings above and below those that returned whose chord holds two firings and more.
        expected: number of returns that the outline should have.
        cut: most neighbouring ends of one side at one azimuth where the outline isn't.
    """

    outside: Floats
    missing_left: float
    missing_right: float
    missing_inside: float
    missing_rings: int
    expected: float
    cut: int


def coverage(evidence: Evidence, T_target_lidar: Floats, further: float) -> Coverage:
    """Count returns outside the outline, and firings that are missing inside.

    Args:
        evidence: of a scan with rings.
        T_target_lidar: (4, 4).
        further: azimuth by which the rings are seen to reach further, by blooming, rad.
    """
    scan, edges, target = evidence.scan, evidence.problem.edges, evidence.problem.target
    assert scan.ring is not None
    step = edges.azimuth_step
    first = edges.points[::2]
    elevation = np.arctan2(first[:, 2], np.hypot(first[:, 0], first[:, 1]))
    sides = sight_planes((target.vertices - T_target_lidar[:3, 3])[None] @ T_target_lidar[:3, :3])
    right, left = (ends[0] for ends in chords(sides, elevation, edges.reference_azimuth))
    slack = step + float(np.median(evidence.reach(further) / np.linalg.norm(scan.points, axis=1)))
    beyond_left, beyond_right = left - edges.azimuth[::2], edges.azimuth[1::2] - right
    # A ring that looks elsewhere than the table says ends elsewhere, far from there where it runs along the edge.
    at = evidence.problem.geometry(T_target_lidar[None])
    elsewhere = 2 * np.sqrt(at.of_ring[0]) / np.maximum(np.abs(at.along[0]), 1e-6)
    slack_left, slack_right = slack + elsewhere[::2], slack + elsewhere[1::2]
    azimuth, _ = relative_azimuth(scan.points)
    order = np.lexsort((azimuth, scan.ring))
    gaps = np.diff(azimuth[order])[np.diff(scan.ring[order]) == 0] / step
    missing_rings = 0
    if scan.sensor is not None:
        beside = np.r_[: edges.ring[0], edges.ring[-1] + 1 : scan.sensor.n_rings]
        low, high = chords(sides, scan.sensor.elevations[beside], edges.reference_azimuth)
        missing_rings = int(np.count_nonzero(high - low > step + slack))
    return Coverage(
        outside=evidence.outside_beams(T_target_lidar, further),
        missing_left=float(np.maximum(beyond_left - slack_left, 0.0).sum()) / step,
        missing_right=float(np.maximum(beyond_right - slack_right, 0.0).sum()) / step,
        missing_inside=float(np.maximum(np.rint(gaps) - 1, 0).sum()),
        missing_rings=missing_rings,
        expected=float((np.maximum(left - right, 0.0) * edges.revolutions[::2]).sum()) / step,
        cut=max(
            _at_one_azimuth(edges.azimuth[::2], beyond_left, step, slack_left),
            _at_one_azimuth(edges.azimuth[1::2], beyond_right, step, slack_right),
        ),
    )


def _at_one_azimuth(azimuth: Floats, beyond: Floats, step: float, slack: Floats) -> int:
    """Most ends within 1.5 steps of azimuth, the outline being a step and the beam away from each."""
    odd = np.sort(azimuth[np.abs(beyond) > step + slack])
    return int((np.searchsorted(odd, odd + 1.5 * step, side="right") - np.arange(len(odd))).max(initial=0))
