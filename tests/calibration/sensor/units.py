"""Simulated copies of a sensor, each with errors of its own, and boards placed freely in front of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.sensor import Sighting
from optshape_graph.calibration.sensor.graph import Joint
from optshape_graph.calibration.sensor.unknowns import EDGE_SYSTEMATIC
from optshape_graph.factors import AZIMUTH, EDGE_OFFSET, ELEVATION, RANGE_BIAS
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation import AngleErrors, NoiseModel, pose_from_rpy, simulate_target
from optshape_graph.target import Target

BOARDS = ("paper", "pose-optimal", "square")

ANGLE = np.radians(0.05)
"""Standard deviation of hidden errors of elevation and azimuth, rad."""


@dataclass(frozen=True)
class Unit:
    """One copy of a sensor.

    Attributes:
        sensor: its file, which knows nothing of its errors.
        noise: its edge offset is the unit's: anywhere in the beam.
        range_bias: (R,) metres.
        angles: of its rings.
    """

    sensor: SensorModel
    noise: NoiseModel
    range_bias: Floats
    angles: AngleErrors

    @classmethod
    def drawn(cls, name: str, rng: np.random.Generator) -> Unit:
        """Draw a copy of a built-in sensor, which errs by its rings and at edges alone: surfaces are alike."""
        sensor = replace(load_sensor(name), brightness_bias=0.0, blooming=0.0)
        noise = replace(NoiseModel.of(sensor), hit_fraction=float(rng.uniform(0.02, 0.98)), common_edge_spread=0.0)
        n = sensor.n_rings
        angles = AngleErrors(ANGLE * rng.normal(size=n), ANGLE * rng.normal(size=n))
        return cls(sensor, noise, 0.01 * rng.normal(size=n), angles)

    def scan(self, target: Target, T_lidar_target: Floats, rng: np.random.Generator) -> Scan:
        """Return a board's returns in one revolution."""
        return simulate_target(
            target, self.sensor, T_lidar_target, noise=self.noise, rng=rng, range_bias=self.range_bias,
            angle_errors=self.angles,
        )  # fmt: skip

    @property
    def edge_offset(self) -> float:
        """How far inside edges its rings end, in beam widths."""
        return -self.noise.edge_shift / 2

    @property
    def known(self) -> SensorModel:
        """Its file if all its errors were known, but for the systematic of ring ends."""
        nothing, given = np.zeros(self.sensor.n_rings), self.sensor
        offsets = nothing if given.azimuth_offsets is None else given.azimuth_offsets
        return replace(
            given, range_bias=self.range_bias, range_bias_sd=nothing + 1e-5,
            elevations=given.elevations + self.angles.elevation, elevation_sd=nothing + 1e-7,
            azimuth_offsets=offsets + self.angles.azimuth, azimuth_sd=nothing + 1e-7,
            reported_elevations=given.elevations, reported_azimuth_offsets=offsets,
            edge_offset=self.edge_offset, edge_offset_sd=EDGE_SYSTEMATIC,
        )  # fmt: skip

    def errors(self, joint: Joint) -> tuple[Floats, Floats]:
        """Return how far a solution is off (k,) and its covariance (k, k), of ring errors and the edge offset, in
        prior standard deviations."""
        truth = {
            RANGE_BIAS: -self.range_bias / self.sensor.range_bias_sds,
            ELEVATION: self.angles.elevation / self.sensor.elevation_sds,
            AZIMUTH: self.angles.azimuth / self.sensor.azimuth_sds,
            EDGE_OFFSET: np.array([self.edge_offset / self.sensor.edge_offset_sd]),
        }
        index = [k for k, error in enumerate(joint.errors) if error.kind in truth]
        off = [joint.beta[k] - truth[joint.errors[k].kind][joint.errors[k].ring or 0] for k in index]
        return np.array(off), joint.covariance[np.ix_(index, index)]


def placed(sensor: SensorModel, low: float, high: float, rng: np.random.Generator) -> Floats:
    """Return T_lidar_target (4, 4) of a board between two distances, metres, at any roll, within the rings' reach."""
    distance, elevation = rng.uniform(low, high), rng.uniform(*np.percentile(sensor.elevations, [10, 90]))
    position = [distance * np.cos(elevation), 0.0, distance * np.sin(elevation)]
    around = pose_from_rpy([0.0, 0.0, 0.0], [0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    T = pose_from_rpy(position, [rng.uniform(-np.pi, np.pi), *rng.uniform(-0.6, 0.6, 2)])
    return np.asarray(around @ T)


def sightings(
    unit: Unit, scans: int, low: float, high: float, rng: np.random.Generator, boards: Sequence[str] = BOARDS
) -> list[Sighting]:
    """Return what a unit sees of boards in some scans, each board at a new place in each."""
    found = []
    for moment in range(scans):
        for name in boards:
            target = load_target(name)
            returns = unit.scan(target, placed(unit.sensor, low, high, rng), rng)
            if returns.ring is None or len(returns) < 30 or len(np.unique(returns.ring)) < 4:
                continue
            estimate = estimate_pose(returns, target)
            if estimate.status == "ok":
                found.append(Sighting(moment, f"{moment}.pcd", estimate, returns))
    return found
