"""The rig's graph: sensors, targets, the platform, and what sightings share, in one least-squares problem.

    E_s = T_base_sensor      where a sensor is; the base has none
    X_m = T_world_base       where the platform is at a moment, where it moves; at the first it is the world
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

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, D, E, K, L, M, O, P, V, X

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.factors import LENS, OFFSET_SIGMA_M
from optshape_graph.calibration.camera.graph import Discrepancy
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.calibration.rig.points import Corners, Marked, Points, Seen, split, with_lens
from optshape_graph.calibration.rig.sightings import Sighting, TargetInMarkers, persistent, read_as
from optshape_graph.calibration.rig.start import Start
from optshape_graph.calibration.rig.tracks import CLOCK_SIGMA, START_DENSITY, Smooth, Timed, Track
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import EstimationError
from optshape_graph.factors import BiasedMeasurement, SharedError, TemplateMeasurement
from optshape_graph.graph import Chain, Inverse, SharedErrors, Solution, Term, solve
from optshape_graph.se3 import adjoint, inverse

MARKERS_OFF = 0.03
"""Standard deviation of a marker's place about its vertex along each axis, metres."""

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
class Linked(Value):
    """One sighting's rows ||R x + d||^2, by its variables.

    Attributes:
        keys: of the variables.
        blocks: (6, d_k) derivatives, whitened.
        d: (6,) whitened.
        by_pose: (6, 6) by the right perturbation of T_target_lidar, or of T_sensor_target of an image or of markers.
    """

    keys: list[int]
    blocks: list[Floats]
    d: Floats
    by_pose: Floats


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
                for place in _places(sighting.seen.points.relabelled(sighting.S)):
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

    def solve(self, used: Collection[int] | None = None, at: gtsam.Values | None = None) -> RigSolution:
        """Minimise over the sightings, or over those of some numbers.

        Args:
            used: their numbers; None: all.
            at: where to start; None: where the start is.

        Raises:
            EstimationError: the minimum is not found.
        """
        everything = range(len(self.start.sightings))
        numbers = list(everything) if used is None else [n for n in everything if n in used]
        scans = [n for n in numbers if n in self.measurements]
        others = [n for n in numbers if n not in self.measurements]
        seen = [self.start.sightings[n] for n in numbers]
        shared = SharedErrors.of(
            [self.measurements[n] for n in scans],
            [self.chain(self.start.sightings[n]) for n in scans],
            [self.lidars[self.start.sightings[n].sensor] for n in scans],
            self.loss,
        )
        points = [self._points(n) for n in others]
        term = Points.of(
            [one for one, _ in points],
            [_inverse(self.chain(self.start.sightings[n])) for n in others],
            [keys for _, keys in points],
            self.loss,
        )
        values, factors = self._values(seen, {key for _, keys in points for key in keys})
        shared.insert(values)
        motion = self._motion(set(numbers))
        for key, twist in [(self.twist_key(n), self.twists[n]) for n in numbers if n in self.twists]:
            values.insert(key, twist)
        if at is not None:
            for key in [key for key in gtsam.utilities.allPose3s(values).keys() if at.exists(key)]:  # noqa: SIM118 - no mapping
                values.update(key, at.atPose3(key))
        terms: list[Term] = [shared, term, *motion]
        solution = solve(values, terms, factors, self.names())
        if not solution.converged:
            raise EstimationError("the rig's graph did not converge: views contradict each other")
        return RigSolution(self, solution, tuple(scans), tuple(others))

    def names(self) -> dict[int, str]:
        """Return what messages call the variables."""
        names = {key: f"'{name}'" for name, key in self.sensors.items()}
        names |= {key: f"the platform at moment {m}" for m, key in self.moments.items()}
        names |= {key: f"placement {k + 1}" for k, key in enumerate(self.placements.values())}
        return names | {key: f"rings of '{name}'" for name, key in self.lidars.items()}

    def _motion(self, used: Collection[int]) -> list[Smooth]:
        """How targets move from sighting to sighting."""
        terms = []
        for track in self.tracks:
            kept = [(n, time) for n, time in zip(track.numbers, track.times, strict=True) if n in used]
            poses = [(self.placements[self.start.sightings[n].placement], self.twist_key(n)) for n, _ in kept]
            pairs = list(pairwise(poses))
            seconds = np.diff([time for _, time in kept])
            if pairs:
                pose_keys, twist_keys = ([(a[k], b[k]) for a, b in pairs] for k in (0, 1))
                terms.append(Smooth.of(pose_keys, twist_keys, seconds, np.array(self.density)))
        return terms

    def _points(self, number: int) -> tuple[Seen, list[int]]:
        """What an image or markers say, and the keys of what they share with others."""
        sighting = self.start.sightings[number]
        seen, keys = self._seen(sighting)
        if number in self.twists and sighting.sensor != self.base:
            return Timed(seen, self.twists[number]), [*keys, D(self._camera(sighting.sensor))]
        return seen, keys

    def _seen(self, sighting: Sighting) -> tuple[Seen, list[int]]:
        seen, number = sighting.seen, self.targets[sighting.target.name]
        if isinstance(seen, TargetInImage):
            points = seen.points.relabelled(sighting.S)
            keys = [O(number)] * points.printed
            if sighting.sensor not in self.free_lenses:
                return Corners(points, seen.camera), keys
            numbers = self.places[sighting.target.name]
            places = np.array([numbers[place] for place in _places(points)])
            return Corners(points, seen.camera, places), [*keys, P(number), K(self._camera(sighting.sensor))]
        assert isinstance(seen, TargetInMarkers)
        near = sighting.target.vertices[seen.vertices]
        return Marked.of(seen.points, near, seen.vertices, seen.sigma, seen.of_body), [M(number)]

    def _camera(self, name: str) -> int:
        return list(self.start.T_base_sensor).index(name)

    def _values(
        self, seen: Sequence[Sighting], shared: Collection[int]
    ) -> tuple[gtsam.Values, gtsam.NonlinearFactorGraph]:
        """Initial values, and the priors of what sightings of points share."""
        start, values, factors = self.start, gtsam.Values(), gtsam.NonlinearFactorGraph()
        poses = {self.placements[s.placement]: start.T_world_target[s.placement] for s in seen}
        poses |= {self.sensors[s.sensor]: start.T_base_sensor[s.sensor] for s in seen if s.sensor in self.sensors}
        poses |= {self.moments[s.moment]: start.T_world_base[s.moment] for s in seen if s.moment in self.moments}
        for key, T in poses.items():
            values.insert(key, gtsam.Pose3(T))
        sizes = {name: len(s.target) for s in seen for name in [s.target.name]}
        sigmas = {O(number): np.array(OFFSET_SIGMA_M[1:]) for number in self.targets.values()}
        sigmas |= {M(n): np.full(3 * sizes[name], MARKERS_OFF) for name, n in self.targets.items() if name in sizes}
        sigmas |= {P(self.targets[name]): np.ones(3 * len(places)) for name, places in self.places.items()}
        sigmas |= {K(self._camera(name)): np.ones(len(LENS)) for name in self.free_lenses}
        sigmas |= {D(self._camera(name)): np.ones(1) for name in start.T_base_sensor}
        for key in sorted(shared):
            values.insert(key, np.zeros(len(sigmas[key])))
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas[key])
            factors.push_back(gtsam.PriorFactorVector(key, np.zeros(len(sigmas[key])), noise))
        return values, factors


@dataclass(frozen=True, eq=False, repr=False)
class RigSolution(Value):
    """A solved rig.

    Attributes:
        graph: what was solved.
        solution: of its variables.
        scans: numbers of the sightings by LiDARs that took part.
        others: of the others.
    """

    graph: RigGraph
    solution: Solution
    scans: tuple[int, ...]
    others: tuple[int, ...]

    @cached_property
    def chi2(self) -> dict[int, float]:
        """Of each sighting, by number, the chi-square that its own best pose would take away: 6 degrees of freedom."""
        models: Any = self.solution.models
        both = [*zip(self.scans, models[0].chi2, strict=True), *zip(self.others, models[1].chi2, strict=True)]
        return {n: float(value) for n, value in both}

    @cached_property
    def linked(self) -> dict[int, Linked]:
        """Of each sighting, by number, its rows that link poses and what it shares with others."""
        models: Any = self.solution.models
        scans, points, *_ = models
        found = {}
        for n, keys, by, R, by_errors, d, s in zip(
            self.scans, scans.term.chains.keys, scans.term.chains.derivatives(scans.R, scans.state),
            scans.R, scans.E, scans.d, scans.term.sensor, strict=True,
        ):  # fmt: skip
            own = by_errors[:, : len(scans.term.errors[s])]
            found[n] = Linked([*keys, scans.term.keys[s]], [*by, own], d, R)
        first = np.array([rows[:6, :6] for rows in points.rows]).reshape(-1, 6, 6)
        blocks = points.term.chains.derivatives(first, points.state)
        for n, keys, by, rows, shared in zip(
            self.others, points.term.chains.keys, blocks, points.rows, points.term.keys, strict=True
        ):
            columns = split(rows[:6, 6:-1], shared, points.state)
            found[n] = Linked([*keys, *shared], [*by, *columns], rows[:6, -1], rows[:6, :6])
        return found

    def pair(self, a: str, b: str) -> tuple[Floats, Floats]:
        """Return T_a_b (4, 4) of two sensors, and the covariance (6, 6) of its right perturbation, frame b.

        Raises:
            UnobservableError: it moves in a direction that is not observable.
        """
        sensors = self.graph.sensors
        return self.solution.relative([
            *([Inverse(sensors[a])] if a in sensors else []), *([sensors[b]] if b in sensors else []),
        ])  # fmt: skip

    def T_base_sensor(self, name: str) -> Floats:
        """Return where a sensor is (4, 4)."""
        key = self.graph.sensors.get(name)
        return np.eye(4) if key is None else self.solution.pose(key)

    def lens(self, camera: CameraIntrinsics) -> CameraIntrinsics:
        """Return a camera's intrinsics: as given, or, where the lens may be another, the likeliest."""
        if camera.name not in self.graph.free_lenses:
            return camera
        return with_lens(camera, self.solution.values.atVector(K(self.graph._camera(camera.name))))

    def clocks(self) -> tuple[dict[str, float], Floats]:
        """Return by how much more than taken each sensor's clock is ahead of the base's, and the covariance (n, n).

        Sensors that saw nothing move are left out; seconds, in the order of the names.
        """
        names, keys, places = list[str](), list[int](), list[int]()
        values, size = self.solution.values, 0
        models: Any = self.solution.models
        term = models[0].term
        for name in self.graph.start.T_base_sensor:
            key, place = D(self.graph._camera(name)), 0
            if name in self.graph.lidars:
                key = self.graph.lidars[name]
                errors = term.errors[term.keys.index(key)] if key in term.keys else ()
                if CLOCK not in errors:
                    continue
                place = errors.index(CLOCK)
            elif not values.exists(key):
                continue
            names.append(name)
            places.append(size + place)
            keys.append(key)
            size += len(values.atVector(key))
        if not names:
            return {}, np.zeros((0, 0))
        whole = np.concatenate([values.atVector(key) for key in keys])
        covariance = self.solution.system.covariance(keys)[np.ix_(places, places)]
        offsets = {name: float(CLOCK_SIGMA * whole[place]) for name, place in zip(names, places, strict=True)}
        return offsets, CLOCK_SIGMA**2 * covariance

    def ring_errors(self, lidar: str) -> dict[SharedError, tuple[float, float]]:
        """Return each error of a LiDAR's rings, and its standard deviation, in units of the prior's."""
        key = self.graph.lidars[lidar]
        models: Any = self.solution.models
        term = models[0].term
        errors = term.errors[term.keys.index(key)]
        sd = np.sqrt(np.diag(self.solution.covariance([key]))) if errors else np.zeros(0)
        values = self.solution.values.atVector(key)
        return {e: (float(x), float(s)) for e, x, s in zip(errors, values, sd, strict=True) if e != CLOCK}


def _places(points: ImagePoints) -> list[Place]:
    """What tells points of a target from one another."""
    return [(points.printed, tuple((np.round(point, 6) + 0.0).tolist())) for point in points.points]


def _alone(measurement: TemplateMeasurement) -> BiasedMeasurement:
    """The measurement of a scan that shares no errors with others."""
    return BiasedMeasurement(measurement.stack, measurement.n_rows, measurement.T_target_lidar, ())


def _inverse(chain: Chain) -> Chain:
    """The chain of the inverse pose."""
    return [step.key if isinstance(step, Inverse) else Inverse(int(step)) for step in reversed(chain)]  # type: ignore[arg-type]  # a key
