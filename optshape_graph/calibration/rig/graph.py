"""The rig's graph: sensors, targets, the platform, and what sightings share, in one least-squares problem.

    E_s = T_base_sensor      where a sensor is; the base has none
    X_m = T_world_base       where the platform is at a moment, where it moves; at one of them it is the world
    L_p = T_world_target     where a target is in a placement; on a platform that stands still, the world is the base
    B_l                      errors of LiDAR l's rings (ranges, elevations), in their standard deviations
    O_t                      (y, z) by which a printed pattern is off on target t, metres
    K_c                      the lens of camera c, where it may be another, in standard deviations of its prior
    P_t                      how far the points of target t that such a camera saw are off, likewise
    V_p, D_c                 twists of a target that moves, and clocks: see `tracks` (a LiDAR's is among its errors)
    M_t                      how far the markers of target t are from its vertices, metres

A scan measures T_target_lidar = L^-1 X E, an image and markers its inverse.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, L, V, X

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.graph import Discrepancy
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.calibration.rig.sightings import Sighting, persistent, read_as
from optshape_graph.calibration.rig.start import Start
from optshape_graph.calibration.rig.tracks import CLOCK_SIGMA, START_DENSITY, Track
from optshape_graph.factors import BiasedMeasurement, SharedError, TemplateMeasurement
from optshape_graph.graph import Chain, Inverse
from optshape_graph.se3 import adjoint, inverse

Place: TypeAlias = tuple[bool, tuple[float, ...]]
"""Whether a point is printed, and where, metres, target frame."""

CLOCK = SharedError("clock")
"""By how much a LiDAR's clock is ahead, among the errors that its scans share."""

LOSS = 3.0
"""Huber's loss turns from squares to lines at this many standard deviations of a sighting, of six degrees of freedom:
one in ten thousand good ones exceeds it."""


@dataclass(frozen=True)
class Options:
    """What is assumed.

    Attributes:
        range_bias_sigma: standard deviation of a range bias that all rings of a LiDAR have alike, metres, beside what
            the sensor files say of each ring's own; 0: there is none.
        as_they_come: whether the ranges' biases are part of what is measured, for clouds that nobody corrects.
    """

    range_bias_sigma: float = 0.0
    as_they_come: bool = False


@dataclass(frozen=True, eq=False, repr=False)
class RigGraph(Value):
    """A rig's sightings as a graph.

    Attributes:
        start: with the sightings.
        base: whose frame is the platform's.
        options: what is assumed.
        discrepancy: what the scans of LiDARs are off by beyond their noise model, by name.
        loss: Huber's loss turns from squares to lines at this many standard deviations of a sighting.
        free_lenses: names of the cameras whose lens may be another than given.
        tracks: of targets that move.
        density: of acceleration along them: rotation, rad^2/s^3, and translation, m^2/s^3.
    """

    start: Start
    base: str
    options: Options = Options()
    discrepancy: Mapping[str, Discrepancy] = field(default_factory=dict)
    loss: float = LOSS
    free_lenses: frozenset[str] = frozenset()
    tracks: tuple[Track, ...] = ()
    density: tuple[float, float] = START_DENSITY

    @cached_property
    def twists(self) -> dict[int, Floats]:
        """Twist (6,) of the target at each sighting of one that moves, by number."""
        return {n: V for track in self.tracks for n, V in zip(track.numbers, track.twists, strict=True)}

    def twist_key(self, number: int) -> int:
        """Return the key of the twist at a sighting."""
        return int(V(gtsam.Symbol(self.placements[self.start.sightings[number].placement]).index()))

    @cached_property
    def sensors(self) -> dict[str, int]:
        """Key of every sensor but the base."""
        return {name: E(k) for k, name in enumerate(self.start.T_base_sensor) if name != self.base}

    @cached_property
    def placements(self) -> dict[str, int]:
        """Key of every placement."""
        return {placement: L(k) for k, placement in enumerate(self.start.T_world_target)}

    @cached_property
    def moments(self) -> dict[int, int]:
        """Key of the platform's pose at every moment but those that are the world's."""
        poses = self.start.T_world_base
        return {m: X(k) for k, (m, T) in enumerate(poses.items()) if not np.array_equal(T, np.eye(4))}

    @cached_property
    def lidars(self) -> dict[str, int]:
        """Key of the errors of every LiDAR's rings."""
        names = dict.fromkeys(s.sensor for s in self.start.sightings if isinstance(s.seen, TargetInScan))
        return {name: B(k) for k, name in enumerate(names)}

    @cached_property
    def targets(self) -> dict[str, int]:
        """Number of every target, as in the keys O and M."""
        return {name: k for k, name in enumerate(dict.fromkeys(s.target.name for s in self.start.sightings))}

    @cached_property
    def places(self) -> dict[str, dict[Place, int]]:
        """Of each target, a number for every point of it that images by free lenses show."""
        found: dict[str, dict[Place, int]] = {}
        for sighting in self.start.sightings:
            if isinstance(sighting.seen, TargetInImage) and sighting.sensor in self.free_lenses:
                numbers = found.setdefault(sighting.target.name, {})
                for place in places_of(sighting.seen.points.relabelled(sighting.S)):
                    numbers.setdefault(place, len(numbers))
        return found

    @cached_property
    def measurements(self) -> dict[int, BiasedMeasurement]:
        """Of every scan, by number of the sighting, as it is read."""
        found: dict[int, BiasedMeasurement] = {}
        for lidar in self.lidars:
            numbers, scans = list[int](), list[TargetInScan]()
            for n, sighting in enumerate(self.start.sightings):
                if sighting.sensor == lidar and isinstance(sighting.seen, TargetInScan):
                    numbers.append(n)
                    scans.append(sighting.seen)
            if self.options.as_they_come:
                given = [_alone(scan.uncorrected) for scan in scans]
            else:
                given = persistent(scans, self.options.range_bias_sigma)
            for n, measurement in zip(numbers, given, strict=True):
                found[n] = read_as(measurement, self.start.sightings[n].S)
                if lidar in self.discrepancy:
                    # Exp(x) T = T Exp(Ad(T^-1) x)
                    by = adjoint(inverse(found[n].T_target_lidar)) * self.discrepancy[lidar].sigmas
                    found[n] = found[n].loosened(by @ by.T)
                if n in self.twists and lidar != self.base:
                    effect = -CLOCK_SIGMA * self.twists[n][:, None]
                    found[n] = found[n].displaced([CLOCK], effect, found[n].T_target_lidar)
        return found

    def chain(self, sighting: Sighting) -> Chain:
        """Return what T_target_sensor of a sighting is made of."""
        moment = [self.moments[sighting.moment]] if sighting.moment in self.moments else []
        sensor = [self.sensors[sighting.sensor]] if sighting.sensor in self.sensors else []
        return [Inverse(self.placements[sighting.placement]), *moment, *sensor]

    def names(self) -> dict[int, str]:
        """Return what messages call the variables."""
        names = {key: f"'{name}'" for name, key in self.sensors.items()}
        names |= {key: f"the platform at moment {m}" for m, key in self.moments.items()}
        names |= {key: f"placement {k + 1}" for k, key in enumerate(self.placements.values())}
        return names | {key: f"rings of '{name}'" for name, key in self.lidars.items()}

    def camera_number(self, name: str) -> int:
        """Return the number of a camera, as in the keys K and D."""
        return list(self.start.T_base_sensor).index(name)


def places_of(points: ImagePoints) -> list[Place]:
    """Return what tells points of a target from one another."""
    return [(points.printed, tuple((np.round(point, 6) + 0.0).tolist())) for point in points.points]


def _alone(measurement: TemplateMeasurement) -> BiasedMeasurement:
    """The measurement of a scan that shares no errors with others."""
    return BiasedMeasurement(measurement.stack, measurement.n_rows, measurement.T_target_lidar, ())
