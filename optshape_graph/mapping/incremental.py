"""Landmark SLAM, scan by scan: odometry and sightings in, poses, landmarks and their covariances out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Literal

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.factors import summarise
from optshape_graph.factors._noise import gaussian
from optshape_graph.factors.se3 import adjoint, inverse
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.mapping.association import Pairing, associate, gated, plain, predictions
from optshape_graph.mapping.candidates import MOST_CARRIED, Candidate
from optshape_graph.mapping.locate import locate
from optshape_graph.mapping.map import Landmark, Map, rigid
from optshape_graph.mapping.priors import joint_prior, sqrt_information
from optshape_graph.mapping.sighting import Sighting
from optshape_graph.mapping.smoother import Smoother
from optshape_graph.mapping.track import MappingProblem, Match, Odometry, Start, Track
from optshape_graph.target import Target

AT_THE_ORIGIN = Start(np.eye(4), 1e-8 * np.eye(6))
"""The world is the first pose's LiDAR frame."""

LOSS = 4.1
"""Huber's loss turns from squares to lines at this many standard deviations: 99 % of what is distributed normally in
six dimensions is nearer."""

NEAREST = 12
"""How many landmarks a sighting without a name is compared with at most: those nearest to where it was seen."""

STALE_M = 5e-4
"""A summary is made again when the target has turned so far since that the second-order term moves a return by this."""

LOOK_EVERY, CHECKED_NEW, CHECKED_OLD = 10, 40, 80
"""Every how many poses summaries are looked at, and how many: of the newest, and of the others in turn."""

SINGULAR = "it makes the graph singular"
"""Reason of a rejection."""

SETTLING = 10
"""Rounds of `settle` at most."""

Verdict = Literal["matched", "new", "pending", "rejected"]


@dataclass(frozen=True)
class Outcome:
    """What became of a sighting.

    Attributes:
        verdict: "matched" with a landmark; "new" where it made one; "pending" while it takes more sightings to tell;
            "rejected" where it contradicts what is known.
        landmark: name of the landmark, or None.
        reason: why it was not matched, else empty.
    """

    verdict: Verdict
    landmark: str | None = None
    reason: str = ""


@dataclass(eq=False)
class _Known:
    """A landmark in the graph."""

    key: int
    target: Target
    observations: int = 0
    surveyed: bool = False


@dataclass(eq=False)
class _Held:
    """A match in the graph: where it was summarised, and the factor's handle."""

    match: Match
    T_target_lidar: Floats
    handle: int


class LandmarkSlam:
    """SLAM with target landmarks, for a system to embed: one pose after another, each with what was seen from it.

    Only what was checked enters the graph: a sighting that no landmark explains waits outside it until others agree,
    one that contradicts the map is rejected, and what makes GTSAM raise is taken out again.

    Args:
        known: landmarks that are known: surveyed, or a map made before, which this run extends.
        start: the first pose. By default the world's origin; with a known map, it is found from the first sightings
            unless it is given.
        lag: seconds of poses that are kept; older ones are marginalised. None: all are kept, and `problem` can be
            solved as a batch.
        confirmations: how many sightings must agree on a landmark before it enters the map.
        name: of the session.

    Raises:
        InputError: fewer than one confirmation.
    """

    def __init__(
        self,
        known: Map | None = None,
        start: Start | None = None,
        *,
        lag: float | None = None,
        confirmations: int = 2,
        name: str = "session",
    ) -> None:
        if confirmations < 1:
            raise InputError(f"{confirmations} confirmations; expected at least 1")
        self.name = name
        self.confirmations = confirmations
        self.counts: Counter[str] = Counter()
        self._known = known if known is not None and known.landmarks else None
        self._start = AT_THE_ORIGIN if start is None and self._known is None else start
        self._smoother = Smoother(lag)
        self._landmarks: dict[str, _Known] = {}
        self._candidates: list[Candidate] = []
        self._held: list[_Held] = []
        self._floating = False
        self._turn = 0
        self._stamps: list[float] = []
        self._poses: list[Floats] = []  # as last estimated
        self._odometry: list[Odometry] = []
        self._pending: Odometry | None = None
        self._names: Counter[str] = Counter()
        self._loss = gtsam.noiseModel.mEstimator.Huber.Create(LOSS)
        if self._known is not None:
            self._add_known(self._known)

    # ---- in ----------------------------------------------------------------------------------------------------------

    def add_odometry(
        self, stamp: float, T_previous_current: Floats | None = None, covariance: Floats | None = None
    ) -> int:
        """Begin a new pose.

        Without odometry nothing links it to the pose before: it floats until known landmarks are recognised from it,
        and if they are not, the next one takes its place.

        Args:
            stamp: seconds, after that of the pose before.
            T_previous_current: (4, 4) pose of the LiDAR now in its frame at the pose before; None: not known.
            covariance: (6, 6) of its right perturbation, rotation first; positive definite.

        Returns:
            The pose's number.

        Raises:
            InputError: a stamp that is not later, or odometry that is none; the pose has not begun then.
        """
        if not np.isfinite(stamp) or (self._stamps and stamp <= self._stamps[-1]):
            raise InputError(f"stamp {stamp} does not follow {self._stamps[-1] if self._stamps else 'nothing'}")
        if self._floating:
            self._stamps[-1] = stamp
            return len(self._poses) - 1
        self._flush()
        newest = len(self._poses)
        if T_previous_current is not None and covariance is not None and newest:
            T = rigid(T_previous_current, "odometry")
            self._pending = Odometry(newest - 1, newest, T, _positive(covariance))
            self._poses.append(self._poses[-1] @ T)
            self._stamps.append(stamp)
            return newest
        self._poses.append(np.eye(4))
        self._stamps.append(stamp)
        if newest == 0 and self._start is not None:
            self._add_first(self._start)
        else:
            self._floating = True
        return newest

    def add_measurements(self, sightings: Sequence[Sighting]) -> list[Outcome]:
        """Add what was seen from the newest pose.

        Returns:
            What became of each sighting.

        Raises:
            InputError: there is no pose yet.
        """
        if not self._poses:
            raise InputError("no pose to measure from: begin one with add_odometry")
        outcomes: list[Outcome | None] = [None] * len(sightings)
        if self._floating:
            found = locate(sightings, self._landmark_map())
            if found is None:
                self.counts["pending"] += len(sightings)
                return [Outcome("pending", None, "where this is in the map is not clear") for _ in sightings]
            self._poses[-1], chosen = found
        else:
            chosen = self._associate(sightings) if self._landmarks else [None] * len(sightings)
        paired = [pairing for pairing in chosen if pairing is not None]
        outcome = Outcome("matched") if self._flush(sightings, paired) else Outcome("rejected", None, SINGULAR)
        for pairing in paired:
            outcomes[pairing.sighting] = replace(outcome, landmark=pairing.landmark)
        result = [outcome or self._carry(sighting) for sighting, outcome in zip(sightings, outcomes, strict=True)]
        self.counts.update(outcome.verdict for outcome in result)
        self._look_again()
        return result

    def settle(self) -> None:
        """Bring all linearisations up to date: after a loop was closed, updates do so only bit by bit."""
        self._flush()
        for _ in range(SETTLING):
            if not self._held or not self._resummarise(self._held):
                break

    # ---- out ---------------------------------------------------------------------------------------------------------

    @property
    def pose(self) -> Floats:
        """(4, 4) T_world_lidar of the newest pose.

        Raises:
            EstimationError: nothing says yet where it is.
        """
        if not self._poses or self._floating:
            raise EstimationError("where the newest pose is in the map is not known")
        self._flush()
        return self._poses[-1]

    @property
    def trajectory(self) -> Trajectory:
        """All poses; those that a lag has marginalised as they were estimated last."""
        self._refresh()
        n = len(self._poses) - int(self._floating)
        return Trajectory(np.array(self._poses[:n]).reshape(-1, 4, 4), np.array(self._stamps[:n]), self.name)

    @property
    def landmarks(self) -> dict[str, Floats]:
        """T_world_target (4, 4) of each landmark."""
        self._flush()
        return {name: self._smoother.pose(landmark.key) for name, landmark in self._landmarks.items()}

    @property
    def landmark_names(self) -> tuple[str, ...]:
        """Names of the landmarks in the map."""
        return tuple(self._landmarks)

    @property
    def carried(self) -> int:
        """Number of candidates that may still become landmarks."""
        return len(self._candidates)

    def covariance(self, landmarks: Sequence[str] = (), poses: Sequence[int] = ()) -> Floats:
        """Return the joint covariance (d, d) of landmarks, then poses, each of its right perturbation, rotation first.

        Raises:
            InputError: no such landmark or pose, or one that a lag has marginalised.
        """
        self._flush()
        keys = []
        for name in landmarks:
            if name not in self._landmarks:
                raise InputError(f"no landmark '{name}'; the map has {', '.join(self._landmarks) or 'none'}")
            keys.append(self._landmarks[name].key)
        for number in poses:
            if X(number) not in self._smoother:
                raise InputError(f"pose {number} is not in the graph")
            keys.append(X(number))
        return self._smoother.covariance(keys)

    def map(self) -> Map:
        """Return the map as it is."""
        found = self._landmark_map()
        earlier = {} if self._known is None else dict(self._known.trajectories)
        return replace(found, trajectories=earlier | {self.name: self.trajectory})

    def problem(self) -> MappingProblem:
        """Return all that was measured, with the present estimates, to be solved as a batch.

        Raises:
            InputError: a lag has marginalised part of it.
        """
        if self._smoother.lag is not None:
            raise InputError("with a lag, older measurements are not kept: there is no batch to solve")
        trajectory = self.trajectory
        assert trajectory.stamps is not None  # they are ours
        track = Track(
            self.name, trajectory.stamps, trajectory.poses, tuple(self._odometry),
            tuple(held.match for held in self._held), self._start,
        )  # fmt: skip
        targets = {name: landmark.target for name, landmark in self._landmarks.items()}
        return MappingProblem((track,), targets, self.landmarks, self._known)

    def _landmark_map(self) -> Map:
        names = list(self._landmarks)
        if not names:
            return Map(())
        joint = self.covariance(names)
        landmarks = []
        for k, (name, landmark) in enumerate(self._landmarks.items()):
            block = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
            T = self._smoother.pose(landmark.key)
            landmarks.append(Landmark(name, landmark.target, T, block, landmark.observations))
        return Map(tuple(landmarks), joint)

    # ---- the graph ---------------------------------------------------------------------------------------------------

    def _add_known(self, known: Map) -> None:
        values, keys = gtsam.Values(), []
        for landmark in known.landmarks:
            entry = self._new_entry(landmark.id, landmark.target)
            entry.observations, entry.surveyed = landmark.observations, True
            values.insert(entry.key, gtsam.Pose3(landmark.T_world_target))
            keys.append(entry.key)
        try:
            factors = joint_prior(keys, [m.T_world_target for m in known.landmarks], known.covariance)
        except np.linalg.LinAlgError as error:
            raise InputError("the covariance of the known landmarks is not positive definite") from error
        self._smoother.update(factors, values)

    def _add_first(self, start: Start) -> None:
        values, pose = gtsam.Values(), gtsam.Pose3(rigid(start.T_world_lidar, "start"))
        values.insert(X(0), pose)
        prior = gtsam.PriorFactorPose3(X(0), pose, gaussian(sqrt_information(_positive(start.covariance))))
        self._smoother.update([prior], values, stamps={X(0): self._stamps[0]})
        self._poses[0] = start.T_world_lidar

    def _flush(self, sightings: Sequence[Sighting] = (), pairings: Sequence[Pairing] = ()) -> bool:
        """Put the pending odometry and pairings into the graph; say whether the pairings went in."""
        odometry, newest = self._pending, len(self._poses) - 1
        if odometry is None and not pairings:
            return True
        factors: list[gtsam.NonlinearFactor] = [
            p.summary.factor(self._landmarks[p.landmark].key, X(newest), self._loss) for p in pairings
        ]
        values = gtsam.Values()
        if odometry is not None:
            noise = gaussian(sqrt_information(odometry.covariance))
            factors.append(gtsam.BetweenFactorPose3(X(odometry.i), X(odometry.j), gtsam.Pose3(odometry.T_i_j), noise))
        if odometry is not None or self._floating:
            values.insert(X(newest), gtsam.Pose3(self._poses[newest]))
        try:
            handles = self._smoother.update(factors, values, stamps={X(newest): self._stamps[newest]})
        except EstimationError:
            if not pairings:
                raise
            self._flush()
            return False
        self._floating, self._pending = False, None
        if odometry is not None:
            self._odometry.append(odometry)
        for p, handle in zip(pairings, handles, strict=False):
            match = Match(newest, p.landmark, sightings[p.sighting], p.hypothesis)
            self._held.append(_Held(match, p.T_target_lidar, handle))
            self._landmarks[p.landmark].observations += 1
        self._forget()
        self._poses[-1] = self._smoother.pose(X(newest))
        return True

    def _factors(self, matches: Sequence[Match], T_target_lidar: Sequence[Floats]) -> list[gtsam.NonlinearFactor]:
        if not matches:
            return []
        summaries = summarise([match.measurement for match in matches], np.stack(T_target_lidar))
        return [
            summary.factor(self._landmarks[match.landmark].key, X(match.pose), self._loss)
            for match, summary in zip(matches, summaries, strict=True)
        ]

    def _look_again(self) -> None:
        """Make stale summaries again, now and then, of the newest matches and of some others in turn."""
        n = len(self._held)
        if n and len(self._poses) % LOOK_EVERY == 0:
            self._turn = (self._turn + CHECKED_OLD) % n
            in_turn = ((self._turn + k) % n for k in range(min(CHECKED_OLD, n)))
            self._resummarise([self._held[k] for k in {*range(max(0, n - CHECKED_NEW), n), *in_turn}])

    def _resummarise(self, held: Sequence[_Held]) -> int:
        """Make those summaries again whose target has turned since; return how many."""
        keys = {X(h.match.pose) for h in held} | {self._landmarks[h.match.landmark].key for h in held}
        pose = {key: self._smoother.pose(key) for key in keys}
        targets = np.stack([pose[self._landmarks[h.match.landmark].key] for h in held])
        now = inverse(targets) @ np.stack([pose[X(h.match.pose)] for h in held])
        stale = np.flatnonzero(_moved(np.stack([h.T_target_lidar for h in held]), now) > STALE_M)
        if len(stale):
            again = [held[int(k)] for k in stale]
            factors = self._factors([h.match for h in again], list(now[stale]))
            handles = self._smoother.update(factors, gtsam.Values(), [h.handle for h in again])
            for h, T, handle in zip(again, now[stale], handles, strict=True):
                h.T_target_lidar, h.handle = T, handle
        return len(stale)

    def _forget(self) -> None:
        """Let go of what a lag has marginalised."""
        if self._smoother.lag is None:
            return
        self._held = [h for h in self._held if X(h.match.pose) in self._smoother]
        self._odometry.clear()
        self._candidates = [c for c in self._candidates if X(c.sightings[0][0]) in self._smoother]

    def _refresh(self) -> None:
        self._flush()
        for number in range(len(self._poses)):
            if X(number) in self._smoother:
                self._poses[number] = self._smoother.pose(X(number))

    # ---- what is what ------------------------------------------------------------------------------------------------

    def _associate(self, sightings: Sequence[Sighting]) -> list[Pairing | None]:
        now = self._poses[-1]
        pairings = predictions(sightings, [self._possible(sighting, now) for sighting in sightings], now)
        if not pairings:
            return [None] * len(sightings)
        if self._pending is not None:
            certain = plain(pairings, len(sightings), self._pending.covariance)
            if certain is not None:
                return certain
        order = {name: k for k, name in enumerate(dict.fromkeys(pairing.landmark for pairing in pairings))}
        covariance = self._with_newest([self._landmarks[name].key for name in order])
        return associate(gated(pairings, covariance, order), len(sightings), covariance, order)

    def _possible(self, sighting: Sighting, T_world_lidar: Floats) -> dict[str, Floats]:
        """Return the landmarks that a sighting may be of: the one it names, or those of its template nearby."""
        if sighting.landmark is not None:
            landmark = self._landmarks.get(sighting.landmark)
            return {} if landmark is None else {sighting.landmark: self._smoother.pose(landmark.key)}
        poses = {
            name: self._smoother.pose(landmark.key)
            for name, landmark in self._landmarks.items()
            if landmark.target.name == sighting.target.name
        }
        seen_at = (T_world_lidar @ sighting.T_lidar_target())[:3, 3]
        nearest = sorted(poses, key=lambda name: float(np.linalg.norm(poses[name][:3, 3] - seen_at)))
        return {name: poses[name] for name in islice(nearest, NEAREST)}

    def _with_newest(self, keys: Iterable[int]) -> Floats:
        """Return the joint covariance of landmarks and the newest pose, whose odometry may still be pending."""
        keys, newest = list(keys), len(self._poses) - 1
        if self._pending is None:
            return self._smoother.covariance([*keys, X(newest)])
        joint = self._smoother.covariance([*keys, X(newest - 1)])
        # X' = X D moves by Ad(D^-1) xi + the error of D.
        J = np.eye(len(joint))
        J[-6:, -6:] = adjoint(inverse(self._pending.T_i_j))
        joint = J @ joint @ J.T
        joint[-6:, -6:] += self._pending.covariance
        return joint

    def _carry(self, sighting: Sighting) -> Outcome:
        """Keep a sighting that no landmark explains with the candidate that it agrees with, or as a new one."""
        if not sighting.determined:
            return Outcome("rejected", sighting.landmark, "it determines no pose, and no known landmark explains it")
        newest = len(self._poses) - 1
        candidate = next((c for c in self._candidates if c.takes(newest, sighting, self._pair)), None)
        if candidate is None:
            candidate = Candidate([(newest, sighting)])
            self._candidates.append(candidate)
            self._candidates = sorted(self._candidates, key=lambda c: c.latest)[-MOST_CARRIED:]
        choice = candidate.resolved()
        if choice is None or len(candidate.sightings) < self.confirmations:
            if sighting.landmark in self._landmarks:
                return Outcome("rejected", sighting.landmark, "it is not where that landmark is")
            return Outcome("pending", sighting.landmark, "others must agree first")
        first_pose, first = candidate.sightings[0]
        T_world_target = self._poses_of([first_pose])[0] @ inverse(first.summaries[choice[0]].T_target_lidar)
        rivals = self._rivals(candidate, T_world_target)
        strongest = max((self._landmarks[name].observations for name in rivals), default=0)
        if rivals and (
            self._smoother.lag is not None
            or len(candidate.sightings) <= strongest
            or any(self._landmarks[name].surveyed for name in rivals)
        ):
            return Outcome("rejected", sighting.landmark, f"landmark '{rivals[0]}' is known better, and contradicts it")
        for name in rivals:
            self._remove(name)
        promoted = self._promote(candidate, choice, T_world_target)
        return Outcome("new", promoted) if promoted else Outcome("rejected", None, SINGULAR)

    def _rivals(self, candidate: Candidate, T_world_target: Floats) -> list[str]:
        """Return the landmarks that cannot be true together with a new one: of its name, or in its place."""
        _, first = candidate.sightings[0]
        rivals = []
        for name, landmark in self._landmarks.items():
            apart = np.linalg.norm(self._smoother.pose(landmark.key)[:3, 3] - T_world_target[:3, 3])
            if name == candidate.landmark or apart < min(landmark.target.circumradius, first.target.circumradius):
                rivals.append(name)
        return rivals

    def _promote(self, candidate: Candidate, choice: Sequence[int], T_world_target: Floats) -> str | None:
        """Make a landmark of a candidate; None if the graph does not bear it."""
        target = candidate.sightings[0][1].target
        name = candidate.landmark or self._unused_name(target)
        entry = self._new_entry(name, target)
        matches = [
            Match(pose, name, sighting, hypothesis)
            for (pose, sighting), hypothesis in zip(candidate.sightings, choice, strict=True)
            if X(pose) in self._smoother
        ]
        poses = self._poses_of([match.pose for match in matches])
        T_target_lidar = [inverse(T_world_target) @ T for T in poses]
        values = gtsam.Values()
        values.insert(entry.key, gtsam.Pose3(T_world_target))
        self._candidates.remove(candidate)
        try:
            handles = self._smoother.update(self._factors(matches, T_target_lidar), values)
        except EstimationError:
            del self._landmarks[name]
            return None
        entry.observations = len(matches)
        self._held += [_Held(m, T, handle) for m, T, handle in zip(matches, T_target_lidar, handles, strict=True)]
        return name

    def _remove(self, name: str) -> None:
        """Take a landmark out of the graph with all its matches: it has been outvoted."""
        gone = [h for h in self._held if h.match.landmark == name]
        self._held = [h for h in self._held if h.match.landmark != name]
        self._smoother.update([], gtsam.Values(), [h.handle for h in gone])
        del self._landmarks[name]
        self.counts["landmarks outvoted"] += 1

    def _new_entry(self, name: str, target: Target) -> _Known:
        entry = _Known(L(self._names.total()), target)
        self._names[target.name] += 1
        self._landmarks[name] = entry
        return entry

    def _unused_name(self, target: Target) -> str:
        k = self._names[target.name]
        while f"{target.name}-{k}" in self._landmarks:
            k += 1
        return f"{target.name}-{k}"

    def _poses_of(self, numbers: Iterable[int]) -> list[Floats]:
        return [self._smoother.pose(X(number)) for number in numbers]

    def _pair(self, a: int, b: int) -> tuple[Floats, Floats, Floats]:
        """Two poses and their joint covariance."""
        T_a, T_b = self._poses_of([a, b])
        return T_a, T_b, self._smoother.covariance([X(a), X(b)])


def _moved(before: Floats, now: Floats) -> Floats:
    """(m,) metres by which a turn between poses (m, 4, 4) moves returns of the target, beyond what is linear in it."""
    turn = np.swapaxes(before[:, :3, :3], 1, 2) @ now[:, :3, :3]
    # 3 - tr R = 2 (1 - cos a) = a^2 for small angles.
    squared = 3.0 - np.einsum("mii->m", turn)
    return np.asarray(0.5 * squared * np.linalg.norm(now[:, :3, 3], axis=1))


def _positive(covariance: Floats) -> Floats:
    C = np.asarray(covariance, float)
    if C.shape != (6, 6) or not np.isfinite(C).all() or np.linalg.eigvalsh(C).min() <= 0:
        raise InputError(f"odometry covariance: expected 6 x 6, positive definite; found shape {C.shape}: {C.tolist()}")
    return C
