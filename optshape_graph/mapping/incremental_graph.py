"""The graph of a running map: poses, landmarks and what links them, on a smoother that survives what it is given.

A match is held as the sighting it came from. Its factor is a summary, which holds where it was made: as the estimate
moves on, stale summaries are made again, some after every few poses, or all of them when asked to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.factors import Summary, summarise
from optshape_graph.factors._rows import gaussian
from optshape_graph.factors.summary import linearise
from optshape_graph.graph.linear import LinearSystem
from optshape_graph.graph.shared import Gain, gain, persistent
from optshape_graph.graph.terms import huber_weight
from optshape_graph.mapping.map import Landmark, Map
from optshape_graph.mapping.places import SLACK, Places
from optshape_graph.mapping.smoother import Smoother, joint_prior, root_of
from optshape_graph.mapping.track import Match, Odometry, Sighting, Start
from optshape_graph.se3 import adjoint, inverse
from optshape_graph.target import Target

LOSS = 4.1
"""Huber's loss turns from squares to lines at this many standard deviations: 99 % of what is distributed normally in
six dimensions is nearer."""

STALE_M = 5e-4
"""A summary is made again when the target has turned so far since that the second-order term moves a return by this."""

CHECKED_NEW, CHECKED_OLD = 40, 40
"""How many summaries are looked at at a time: of the newest, and of the others in turn."""

MOVED = 4
"""Times that the smoother has eliminated as many variables again as there are landmarks, before all places are looked
at: that costs a small part of its work. Landmarks that are in question are looked at in any case."""

NEAREST = 12
"""How many landmarks a sighting without a name is compared with at most: those nearest to where it was seen."""

SETTLING = 10
"""Rounds of `settle` at most."""


@dataclass(eq=False)
class Known:
    """A landmark in the graph.

    Attributes:
        key: of T_world_target.
        target: its template.
        observations: number of sightings in the graph.
        surveyed: it was known before, and is no result of this graph.
    """

    key: int
    target: Target
    observations: int = 0
    surveyed: bool = False


@dataclass(eq=False, slots=True)
class _Held:
    """A match in the graph: where it was summarised, and the factor's handle."""

    match: Match
    T_target_lidar: Floats
    handle: int


class _Pending(NamedTuple):
    """The newest pose while nothing but odometry, or nothing at all, links it: it goes in with its matches."""

    pose: int
    stamp: float
    T_world_lidar: Floats
    odometry: Odometry | None


class _Waiting(NamedTuple):
    """A new landmark and its matches: they go in with the next pose, since an update costs the same for more."""

    name: str
    T_world_target: Floats
    matches: Sequence[tuple[Match, Floats, Summary]]


class IncrementalGraph:
    """Poses by number and landmarks by name; whatever makes GTSAM raise is taken out again.

    The newest pose enters the smoother together with its matches and what landmarks are new, in one update; all can be
    asked for before.

    Attributes:
        landmarks: what is known of each, by name.
    """

    def __init__(self, lag: float | None) -> None:
        self.landmarks: dict[str, Known] = {}
        self._pending: _Pending | None = None
        self._waiting: dict[str, _Waiting] = {}
        self._odometry: list[Odometry] = []
        self._smoother = Smoother(lag)
        self._places = Places()
        self._looked = 0  # the smoother's work when all places were looked at
        self._held: list[_Held] = []
        self._turn = 0
        self._made = 0
        self._loss = gtsam.noiseModel.mEstimator.Huber.Create(LOSS)

    def __contains__(self, pose: int) -> bool:
        return X(pose) in self._smoother or (self._pending is not None and self._pending.pose == pose)

    @property
    def lag(self) -> float | None:
        """Seconds of poses that are kept; None: all are."""
        return self._smoother.lag

    @property
    def matches(self) -> tuple[Match, ...]:
        """All matches that are in force."""
        self._flush()
        return tuple(held.match for held in self._held)

    @property
    def odometry(self) -> tuple[Odometry, ...]:
        """Between the poses, as far as a lag has kept it."""
        self._flush()
        return tuple(self._odometry)

    @property
    def pending(self) -> Odometry | None:
        """The odometry that alone leads to the newest pose so far; None: it is not alone, or there is none."""
        return None if self._pending is None else self._pending.odometry

    # ---- out ---------------------------------------------------------------------------------------------------------

    def T_world_lidar(self, pose: int) -> Floats:
        """Return the estimate (4, 4) of a pose."""
        if self._pending is not None and self._pending.pose == pose:
            return self._pending.T_world_lidar
        return self._smoother.pose(X(pose))

    def T_world_target(self, name: str) -> Floats:
        """Return the estimate (4, 4) of a landmark."""
        if name in self._waiting:
            return self._waiting[name].T_world_target
        return self._smoother.pose(self.landmarks[name].key)

    def near(self, sighting: Sighting, T_world_lidar: Floats) -> dict[str, Floats]:
        """Return T_world_target (4, 4) of the landmarks that a sighting from the newest pose may be of, nearest first.

        Args:
            sighting: without a name.
            T_world_lidar: (4, 4) newest pose.
        """
        return self._up_to_date(lambda: self._places.near(sighting, T_world_lidar)[:NEAREST])

    def within(self, place: Floats, distance: float) -> dict[str, Floats]:
        """Return T_world_target (4, 4) of the landmarks about a place (3,), to a distance in metres or a bit more."""
        return self._up_to_date(lambda: self._places.within(place, distance))

    def apart(self, pose: int, distance: float) -> float:
        """Return how far off what a pose saw may seem from the newest one, by odometry alone; see `Places`."""
        return self._places.apart(pose, distance)

    def _up_to_date(self, asked: Callable[[], list[str]]) -> dict[str, Floats]:
        """Ask the array of places for landmarks, again if it was not up to date."""
        if self._smoother.worked - self._looked > MOVED * len(self._places):
            self._put_all()
        found = {name: self.T_world_target(name) for name in asked()}
        if self._places.put(found) > SLACK:
            self._put_all()
            found = {name: self.T_world_target(name) for name in asked()}
        return found

    def _put_all(self) -> None:
        self._looked = self._smoother.worked
        self._places.put({name: self.T_world_target(name) for name in self.landmarks})

    def covariance(self, landmarks: Sequence[str] = (), poses: Sequence[int] = ()) -> Floats:
        """Return the joint covariance (d, d) of landmarks, then poses, each of its right perturbation, rotation first.

        Raises:
            InputError: no such landmark or pose, or one that a lag has marginalised.
        """
        for name in landmarks:
            if name not in self.landmarks:
                raise InputError(f"no landmark '{name}'; the map has {', '.join(self.landmarks) or 'none'}")
        for pose in poses:
            if pose not in self:
                raise InputError(f"pose {pose} is not in the graph")
        if not self._waiting.keys().isdisjoint(landmarks):
            self._flush()
        keys = [self.landmarks[name].key for name in landmarks]
        pending = self._pending
        # X' = X D moves by Ad(D^-1) xi + the error of D; a pose may be asked for twice.
        before = list(poses)
        if pending is not None and pending.pose in poses:
            if pending.odometry is None:
                raise InputError(f"pose {pending.pose} is linked to nothing yet")
            before = [pending.odometry.i if pose == pending.pose else pose for pose in poses]
        distinct = list(dict.fromkeys(before))
        joint = self._smoother.covariance([*keys, *map(X, distinct)])
        if distinct == list(poses):
            return joint
        J = np.zeros((6 * (len(keys) + len(poses)), len(joint)))
        J[: 6 * len(keys), : 6 * len(keys)] = np.eye(6 * len(keys))
        E = np.zeros((len(J), 6))  # by the error of D
        for n, (pose, known) in enumerate(zip(poses, before, strict=True), len(keys)):
            rows, columns = slice(6 * n, 6 * n + 6), 6 * (len(keys) + distinct.index(known))
            D = np.eye(4)
            if pending is not None and pending.odometry is not None and pose == pending.pose:
                D, E[rows] = pending.odometry.T_i_j, np.eye(6)
            J[rows, columns : columns + 6] = adjoint(inverse(D))
        added = E @ pending.odometry.covariance @ E.T if pending is not None and pending.odometry is not None else 0.0
        return np.asarray(J @ joint @ J.T + added)

    def covariance_with_biases(self, landmarks: Sequence[str] = (), poses: Sequence[int] = ()) -> Floats:
        """Return the joint covariance, and in it that what a LiDAR's rings keep doesn't average away; see `persistent`.

        Raises:
            InputError: no such landmark or pose, or one that a lag has marginalised.
        """
        self._flush()
        plain = self.covariance(landmarks, poses)
        if all(held.match.sighting.biased is None for held in self._held):
            return plain
        system = self._smoother.system()
        keys = [*(self.landmarks[name].key for name in landmarks), *map(X, poses)]
        return persistent(system, keys, self._gains(system))

    def _gains(self, system: LinearSystem) -> Iterator[Gain]:
        """What errors that are kept add to the information vector, by match; each was taken for its own."""
        held = [one for one in self._held if one.match.sighting.biased is not None]
        model = linearise([one.match.measurement for one in held], self._relative(held))
        weights = huber_weight(np.square(model.residuals).sum(axis=1), LOSS)
        for one, H, weight in zip(held, model.T_target_lidar, weights, strict=True):
            measurement = one.match.biased
            if measurement is not None:  # under this hypothesis it may not be known
                G = gain(measurement, H, measurement.shared, weight)
                target, lidar = self.landmarks[one.match.landmark].key, X(one.match.pose)
                blocks = [(system.index([target]), -adjoint(inverse(H)).T @ G), (system.index([lidar]), G)]
                yield Gain(blocks, [one.match.kept(error) for error in measurement.shared])

    def _relative(self, held: Sequence[_Held]) -> Floats:
        """T_target_lidar (m, 4, 4) of matches, as estimated."""
        targets = {name: self.T_world_target(name) for name in {h.match.landmark for h in held}}
        lidars = {pose: self.T_world_lidar(pose) for pose in {h.match.pose for h in held}}
        return inverse(np.array([targets[h.match.landmark] for h in held])) @ [lidars[h.match.pose] for h in held]

    def map(self) -> Map:
        """Return the landmarks."""
        names = list(self.landmarks)
        if not names:
            return Map(())
        joint = self.covariance_with_biases(names)
        landmarks = []
        for k, (name, known) in enumerate(self.landmarks.items()):
            block = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
            landmarks.append(Landmark(name, known.target, self.T_world_target(name), block, known.observations))
        return Map(tuple(landmarks), joint)

    # ---- in ----------------------------------------------------------------------------------------------------------

    def add_known(self, known: Map) -> None:
        """Add landmarks that are known, with their joint covariance.

        Raises:
            InputError: it is not positive definite.
        """
        values = gtsam.Values()
        for landmark in known.landmarks:
            entry = self._begin(landmark.id, landmark.target)
            entry.observations, entry.surveyed = landmark.observations, True
            place = landmark.T_world_target[:3, 3]
            self._places.add(landmark.id, landmark.target.name, place, landmark.covariance)
            values.insert(entry.key, gtsam.Pose3(landmark.T_world_target))
        keys = [entry.key for entry in self.landmarks.values()]
        try:
            factors = joint_prior(keys, [m.T_world_target for m in known.landmarks], known.covariance)
        except np.linalg.LinAlgError as error:
            raise InputError("the covariance of the known landmarks is not positive definite") from error
        self._smoother.update(factors, values, finite=True)

    def add_start(self, start: Start, stamp: float) -> None:
        """Add the first pose, where it is known to be."""
        values, pose = gtsam.Values(), gtsam.Pose3(start.T_world_lidar)
        values.insert(X(0), pose)
        prior = gtsam.PriorFactorPose3(X(0), pose, gaussian(root_of(start.covariance, "start")))
        self._smoother.update([prior], values, stamps={X(0): stamp})
        self._places.start(start.covariance)

    def begin(self, pose: int, stamp: float, odometry: Odometry) -> Floats:
        """Begin a pose, the next by number, where odometry has it; return the estimate (4, 4) of the one before.

        Args:
            pose: number of the new pose.
            stamp: seconds.
            odometry: to it from the one before.
        """
        if self._pending is not None:
            self._flush()
        before = self.T_world_lidar(odometry.i)
        self._pending = _Pending(pose, stamp, before @ odometry.T_i_j, odometry)
        self._places.move(odometry)
        return before

    def begin_at(self, pose: int, stamp: float, T_world_lidar: Floats) -> None:
        """Begin a pose at (4, 4) that only its matches will link; stamp in seconds."""
        if self._pending is not None:
            self._flush()
        self._pending = _Pending(pose, stamp, T_world_lidar, None)
        self._places.jump(pose)

    def add_matches(self, matches: Sequence[tuple[Match, Floats, Summary]]) -> bool:
        """Add matches of the newest pose, and the pose with them; say whether the graph bears them.

        If it does not, the pose is there without them, unless nothing else links it.

        Args:
            matches: each with T_target_lidar (4, 4) where it was summarised, and its summary there.
        """
        try:
            self._update(matches)
        except EstimationError:
            self._add_waiting()
            if self._pending is not None and self._pending.odometry is None:
                self._pending = None
            self._flush()
            return False
        return True

    def _flush(self) -> None:
        """Put the newest pose, and new landmarks, into the smoother, if they are not there yet."""
        if self._waiting or (self._pending is not None and self._pending.odometry is not None):
            self._update([])

    def _update(self, matches: Sequence[tuple[Match, Floats, Summary]]) -> None:
        """Put the newest pose, its odometry and matches, and new landmarks into the smoother.

        Raises:
            EstimationError: the graph does not bear them; nothing has changed then.
        """
        pending, new = self._pending, list(self._waiting.values())
        if pending is None and not matches and not new:
            return
        links = [*matches, *(link for landmark in new for link in landmark.matches)]
        factors = self._factors([match for match, _, _ in links], [summary for _, _, summary in links])
        finite = all(summary.is_finite for _, _, summary in links)
        values, stamps = gtsam.Values(), {}
        for landmark in new:
            values.insert(self.landmarks[landmark.name].key, gtsam.Pose3(landmark.T_world_target))
        if pending is not None:
            values.insert(X(pending.pose), gtsam.Pose3(pending.T_world_lidar))
            stamps[X(pending.pose)] = pending.stamp
            if pending.odometry is not None:
                i, j = X(pending.odometry.i), X(pending.odometry.j)
                motion, noise = gtsam.Pose3(pending.odometry.T_i_j), gaussian(pending.odometry.sqrt_information)
                factors.append(gtsam.BetweenFactorPose3(i, j, motion, noise))
        handles = self._smoother.update(factors, values, stamps=stamps, finite=finite)
        self._pending = None
        self._waiting.clear()
        if pending is not None and pending.odometry is not None:
            self._odometry.append(pending.odometry)
        for (match, T, _), handle in zip(links, handles, strict=False):
            self._held.append(_Held(match, T, handle))
        for match, _, summary in matches:
            self.landmarks[match.landmark].observations += 1
            self._places.see(match.landmark, match.pose, summary)
        if self.lag is not None:
            self._held = [held for held in self._held if held.match.pose in self]
            self._odometry.clear()

    def add_landmark(self, name: str, target: Target, T_world_target: Floats, matches: Sequence[Match]) -> bool:
        """Add a landmark at T_world_target (4, 4) with its matches; say whether they determine it."""
        entry = self._begin(name, target)
        H = np.array([inverse(T_world_target) @ self.T_world_lidar(match.pose) for match in matches])
        summaries = summarise([match.measurement for match in matches], H)
        values = gtsam.Values()
        values.insert(entry.key, gtsam.Pose3(T_world_target))
        try:
            self._smoother.check(self._factors(matches, summaries), values)
        except EstimationError:
            del self.landmarks[name]
            return False
        entry.observations = len(matches)
        self._waiting[name] = _Waiting(name, T_world_target, list(zip(matches, H, summaries, strict=True)))
        self._places.add(name, target.name, T_world_target[:3, 3])
        for match, summary in zip(matches, summaries, strict=True):
            self._places.see(name, match.pose, summary)
        return True

    def _add_waiting(self) -> None:
        """Put new landmarks into the smoother, without the newest pose; those that the graph does not bear are gone."""
        pending, self._pending = self._pending, None
        try:
            self._update([])
        except EstimationError:
            for name in self._waiting:
                del self.landmarks[name]
                self._places.remove(name)
            self._waiting.clear()
        self._pending = pending

    def remove_landmark(self, name: str) -> None:
        """Take a landmark out of the graph with all its matches."""
        self._flush()
        gone = [held for held in self._held if held.match.landmark == name]
        self._held = [held for held in self._held if held.match.landmark != name]
        self._smoother.update([], gtsam.Values(), [held.handle for held in gone])
        del self.landmarks[name]
        self._places.remove(name)

    # ---- up to date --------------------------------------------------------------------------------------------------

    def look_again(self) -> None:
        """Make stale summaries again, of the newest matches and of some others in turn.

        Those that the graph does not bear as they would be stay as they are.
        """
        self._flush()
        n = len(self._held)
        if n:
            self._turn = (self._turn + CHECKED_OLD) % n
            in_turn = ((self._turn + k) % n for k in range(min(CHECKED_OLD, n)))
            with suppress(EstimationError):
                self._resummarise([self._held[k] for k in {*range(max(0, n - CHECKED_NEW), n), *in_turn}])

    def settle(self) -> None:
        """Linearise everything where it is, and make stale summaries again, until there are none."""
        self._flush()
        with suppress(EstimationError):  # the graph does not bear it: it stays as it is
            for _ in range(SETTLING):
                self._smoother.relinearise()
                if not (self._held and self._resummarise(self._held)):
                    break

    def _resummarise(self, held: Sequence[_Held]) -> int:
        """Make those summaries again whose target has turned since; return how many."""
        now = self._relative(held)
        stale = np.flatnonzero(_moved(np.array([h.T_target_lidar for h in held]), now) > STALE_M)
        if len(stale):
            again = [held[int(k)] for k in stale]
            summaries = summarise([h.match.measurement for h in again], now[stale])
            factors = self._factors([h.match for h in again], summaries)
            handles = self._smoother.update(factors, gtsam.Values(), [h.handle for h in again])
            for h, T, handle in zip(again, now[stale], handles, strict=True):
                h.T_target_lidar, h.handle = T, handle
        return len(stale)

    def _factors(self, matches: Sequence[Match], summaries: Sequence[Summary]) -> list[gtsam.NonlinearFactor]:
        return [
            summary.factor(self.landmarks[match.landmark].key, X(match.pose), self._loss)
            for match, summary in zip(matches, summaries, strict=True)
        ]

    def _begin(self, name: str, target: Target) -> Known:
        entry = self.landmarks[name] = Known(L(self._made), target)
        self._made += 1
        return entry


def _moved(before: Floats, now: Floats) -> Floats:
    """(m,) metres by which a turn between poses (m, 4, 4) moves returns of the target, beyond what is linear in it."""
    # 3 - tr(R^T R') = 2 (1 - cos a) = a^2 for small angles.
    squared = 3.0 - (before[:, :3, :3] * now[:, :3, :3]).sum(axis=(1, 2))
    return np.asarray(0.5 * squared * np.linalg.norm(now[:, :3, 3], axis=1))
