"""Landmark SLAM, scan by scan: odometry and sightings in, poses, landmarks and their covariances out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Literal

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.mapping.association import Pairing, associate, gated, plain, predictions
from optshape_graph.mapping.candidates import MOST_CARRIED, Candidate
from optshape_graph.mapping.incremental_graph import IncrementalGraph
from optshape_graph.mapping.locate import locate
from optshape_graph.mapping.map import Map
from optshape_graph.mapping.track import MappingProblem, Match, Odometry, Sighting, Start, Track
from optshape_graph.se3 import PoseLike, adjoint, as_transform, inverse
from optshape_graph.target import Target

AT_THE_ORIGIN = Start(np.eye(4), 1e-8 * np.eye(6))
"""The world is the first pose's LiDAR frame."""

NEAREST = 12
"""How many landmarks a sighting without a name is compared with at most: those nearest to where it was seen."""

LOOK_EVERY = 20
"""Every how many poses stale summaries are looked for."""

SINGULAR = "it makes the graph singular"
"""Reason of a rejection."""

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


class LandmarkSlam:
    """SLAM with target landmarks, for a system to embed: one pose after another, each with what was seen from it.

    Only what was checked enters the graph: a sighting that no landmark explains waits outside it until others agree,
    one that contradicts the map is rejected, and what makes GTSAM raise is taken out again. The biases that a LiDAR's
    rings keep are taken for each sighting's own here, so that landmarks seen often seem better known than they are:
    `solve_batch` of `problem` solves for them.

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
        self._graph = IncrementalGraph(lag)
        self._candidates: list[Candidate] = []
        self._floating = False
        self._stamps: list[float] = []
        self._poses: list[Floats] = []  # as last estimated
        self._pending: Odometry | None = None
        self._names: Counter[str] = Counter()
        if self._known is not None:
            self._graph.add_known(self._known)
            self._names.update(landmark.target.name for landmark in self._known.landmarks)

    # ---- in ----------------------------------------------------------------------------------------------------------

    def add_odometry(
        self, stamp: float, T_previous_current: PoseLike | None = None, covariance: Floats | None = None
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
            T = as_transform(T_previous_current, "odometry")
            self._pending = Odometry(newest - 1, newest, T, covariance)
            self._poses.append(self._poses[-1] @ T)
            self._stamps.append(stamp)
            return newest
        self._poses.append(np.eye(4))
        self._stamps.append(stamp)
        if newest == 0 and self._start is not None:
            self._graph.add_start(self._start, stamp)
            self._poses[0] = self._start.T_world_lidar
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
            found = locate(sightings, self._graph.map())
            if found is None:
                self.counts["pending"] += len(sightings)
                return [Outcome("pending", None, "where this is in the map is not clear") for _ in sightings]
            self._poses[-1], chosen = found
        else:
            chosen = self._associate(sightings) if self._graph.landmarks else [None] * len(sightings)
        paired = [pairing for pairing in chosen if pairing is not None]
        borne = self._flush(sightings, paired)
        for pairing in paired:
            name = pairing.landmark
            outcomes[pairing.sighting] = Outcome("matched", name) if borne else Outcome("rejected", name, SINGULAR)
        result = [outcome or self._carry(sighting) for sighting, outcome in zip(sightings, outcomes, strict=True)]
        self.counts.update(outcome.verdict for outcome in result)
        if len(self._poses) % LOOK_EVERY == 0:
            self._graph.look_again()
        return result

    def settle(self) -> None:
        """Bring all linearisations up to date: after a loop was closed, updates do so only bit by bit."""
        self._flush()
        self._graph.settle()

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
        return {name: self._graph.T_world_target(name) for name in self._graph.landmarks}

    @property
    def landmark_names(self) -> tuple[str, ...]:
        """Names of the landmarks in the map."""
        return tuple(self._graph.landmarks)

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
        return self._graph.covariance(landmarks, poses)

    def map(self) -> Map:
        """Return the map as it is."""
        self._flush()
        found = self._graph.map()
        earlier = {} if self._known is None else dict(self._known.trajectories)
        return replace(found, trajectories=earlier | {self.name: self.trajectory})

    def problem(self) -> MappingProblem:
        """Return all that was measured, with the present estimates, to be solved as a batch.

        Raises:
            InputError: a lag has marginalised part of it.
        """
        if self._graph.lag is not None:
            raise InputError("with a lag, older measurements are not kept: there is no batch to solve")
        trajectory = self.trajectory
        assert trajectory.stamps is not None  # they are ours
        track = Track(
            self.name, trajectory.stamps, trajectory.poses, tuple(self._graph.odometry), self._graph.matches,
            self._start,
        )  # fmt: skip
        targets = {name: landmark.target for name, landmark in self._graph.landmarks.items()}
        return MappingProblem((track,), targets, self.landmarks, self._known)

    # ---- the newest pose ---------------------------------------------------------------------------------------------

    def _flush(self, sightings: Sequence[Sighting] = (), pairings: Sequence[Pairing] = ()) -> bool:
        """Put the pending odometry and pairings into the graph; say whether the pairings went in."""
        newest = len(self._poses) - 1
        if self._pending is None and not pairings:
            return True
        initial = self._poses[newest] if self._pending is not None or self._floating else None
        matches = [
            (Match(newest, p.landmark, sightings[p.sighting], p.hypothesis), p.T_target_lidar, p.summary)
            for p in pairings
        ]
        try:
            self._graph.add_pose(newest, self._stamps[newest], initial, self._pending, matches)
        except EstimationError:
            if not pairings:
                raise
            self._flush()
            return False
        self._floating, self._pending = False, None
        if self._graph.lag is not None:
            self._candidates = [c for c in self._candidates if c.sightings[0][0] in self._graph]
        self._poses[-1] = self._graph.T_world_lidar(newest)
        return True

    def _refresh(self) -> None:
        self._flush()
        for number in range(len(self._poses)):
            if number in self._graph:
                self._poses[number] = self._graph.T_world_lidar(number)

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
        covariance = self._with_newest(list(order))
        return associate(gated(pairings, covariance, order), len(sightings), covariance, order)

    def _possible(self, sighting: Sighting, T_world_lidar: Floats) -> dict[str, Floats]:
        """Return the landmarks that a sighting may be of: the one it names, or those of its template nearby."""
        name = sighting.landmark
        if name is not None:
            return {name: self._graph.T_world_target(name)} if name in self._graph.landmarks else {}
        poses = {
            name: self._graph.T_world_target(name)
            for name, landmark in self._graph.landmarks.items()
            if landmark.target.name == sighting.target.name
        }
        seen_at = (T_world_lidar @ sighting.T_lidar_target())[:3, 3]
        nearest = sorted(poses, key=lambda name: float(np.linalg.norm(poses[name][:3, 3] - seen_at)))
        return {name: poses[name] for name in islice(nearest, NEAREST)}

    def _with_newest(self, landmarks: Sequence[str]) -> Floats:
        """Return the joint covariance of landmarks and the newest pose, whose odometry may still be pending."""
        newest = len(self._poses) - 1
        if self._pending is None:
            return self._graph.covariance(landmarks, [newest])
        joint = self._graph.covariance(landmarks, [newest - 1])
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
            if sighting.landmark in self._graph.landmarks:
                return Outcome("rejected", sighting.landmark, "it is not where that landmark is")
            return Outcome("pending", sighting.landmark, "others must agree first")
        first_pose, first = candidate.sightings[0]
        T_world_target = self._graph.T_world_lidar(first_pose) @ inverse(first.summaries[choice[0]].T_target_lidar)
        rivals = self._rivals(candidate, T_world_target)
        strongest = max((self._graph.landmarks[name].observations for name in rivals), default=0)
        if rivals and (
            self._graph.lag is not None
            or len(candidate.sightings) <= strongest
            or any(self._graph.landmarks[name].surveyed for name in rivals)
        ):
            return Outcome("rejected", sighting.landmark, f"landmark '{rivals[0]}' is known better, and contradicts it")
        for name in rivals:
            self._graph.remove_landmark(name)
            self.counts["landmarks outvoted"] += 1
        promoted = self._promote(candidate, choice, T_world_target)
        return Outcome("new", promoted) if promoted else Outcome("rejected", None, SINGULAR)

    def _rivals(self, candidate: Candidate, T_world_target: Floats) -> list[str]:
        """Return the landmarks that cannot be true together with a new one: of its name, or in its place."""
        _, first = candidate.sightings[0]
        rivals = []
        for name, landmark in self._graph.landmarks.items():
            apart = np.linalg.norm(self._graph.T_world_target(name)[:3, 3] - T_world_target[:3, 3])
            if name == candidate.landmark or apart < min(landmark.target.circumradius, first.target.circumradius):
                rivals.append(name)
        return rivals

    def _promote(self, candidate: Candidate, choice: Sequence[int], T_world_target: Floats) -> str | None:
        """Make a landmark of a candidate; None if the graph does not bear it."""
        target = candidate.sightings[0][1].target
        name = candidate.landmark or self._unused_name(target)
        matches = [
            Match(pose, name, sighting, hypothesis)
            for (pose, sighting), hypothesis in zip(candidate.sightings, choice, strict=True)
            if pose in self._graph
        ]
        self._candidates.remove(candidate)
        self._names[target.name] += 1
        return name if self._graph.add_landmark(name, target, T_world_target, matches) else None

    def _unused_name(self, target: Target) -> str:
        k = self._names[target.name]
        while f"{target.name}-{k}" in self._graph.landmarks:
            k += 1
        return f"{target.name}-{k}"

    def _pair(self, a: int, b: int) -> tuple[Floats, Floats, Floats]:
        """Two poses and their joint covariance."""
        return self._graph.T_world_lidar(a), self._graph.T_world_lidar(b), self._graph.covariance(poses=[a, b])
