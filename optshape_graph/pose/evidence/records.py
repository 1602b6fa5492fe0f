"""What is known of one target in one scan: measured before its pose is, and found about its pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.factors.measurement import TemplateMeasurement
from optshape_graph.factors.plane_returns import PlaneReturns
from optshape_graph.factors.static import SURFACE, BiasedMeasurement, SharedError
from optshape_graph.plane import ReturnsPlane
from optshape_graph.pose.ends import EndsFit, Problem, RingEnds
from optshape_graph.pose.evidence.residuals import PlaneResiduals, Sheets, Surface
from optshape_graph.scan import Scan
from optshape_graph.se3 import adjoint, inverse

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


def ends_of(evidences: Sequence[Evidence]) -> RingEnds:
    """Return the bounded ring ends of scans whose targets have as many edges, side by side."""
    problems = [evidence.bounded for evidence in evidences]
    return problems[0].ends if len(problems) == 1 else RingEnds.of(problems)


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
