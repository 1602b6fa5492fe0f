"""Landmark SLAM, scan by scan: odometry and sightings in, poses, landmarks and their covariances out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError, InputError, expect
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.mapping.association import Pairing, associate, gated, locate, plain, predictions
from optshape_graph.mapping.candidates import SINGULAR, Candidates, Outcome, Verdict
from optshape_graph.mapping.incremental_graph import IncrementalGraph
from optshape_graph.mapping.map import Map
from optshape_graph.mapping.track import MappingProblem, Match, Odometry, Sighting, Start, Track
from optshape_graph.se3 import PoseLike, as_transform

__all__ = ["LandmarkSlam", "Outcome", "Verdict"]

AT_THE_ORIGIN = Start(np.eye(4), 1e-8 * np.eye(6))
"""The world is the first pose's LiDAR frame."""

LOOK_EVERY = 20
"""Every how many poses stale summaries are looked for."""


class LandmarkSlam:
    """SLAM with target landmarks, for a system to embed: one pose after another, each with what was seen from it.

    Only what was checked enters the graph: a sighting that no landmark explains waits outside it until others agree,
    one that contradicts the map is rejected, and what makes GTSAM raise is taken out again. The biases that a LiDAR's
    rings keep are taken for each sighting's own in the estimates, and are in the covariances, as far as sightings have
    them (`Sighting.biased`) and no lag has forgotten them; `solve_batch` of `problem` solves for them.

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
        self._counts: Counter[str] = Counter()
        self._known = known if known is not None and known.landmarks else None
        self._start = AT_THE_ORIGIN if start is None and self._known is None else start
        self._graph = IncrementalGraph(lag)
        if self._known is not None:
            self._graph.add_known(self._known)
        self._candidates = Candidates(self._graph, confirmations)
        self._seen_now: set[tuple[str, str]] = set()  # landmarks from the newest pose, each by a LiDAR
        self._stamps: list[float] = []
        self._poses: list[Floats] = []  # as last estimated; of a pose that floats there is none yet

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
        self._seen_now.clear()
        if self._floating:
            self._stamps[-1] = stamp
            return len(self._poses)
        newest = len(self._poses)
        if T_previous_current is not None and covariance is not None and newest:
            odometry = Odometry(newest - 1, newest, as_transform(T_previous_current, "T_previous_current"), covariance)
            self._poses[-1] = self._graph.begin(newest, stamp, odometry)
            self._poses.append(self._graph.T_world_lidar(newest))
        elif newest == 0 and self._start is not None:
            self._graph.add_start(self._start, stamp)
            self._poses.append(self._start.T_world_lidar)
        self._stamps.append(stamp)
        return newest

    def add_measurements(self, sightings: Sequence[Sighting]) -> list[Outcome]:
        """Add what was seen from the newest pose.

        Returns:
            What became of each sighting.

        Raises:
            InputError: there is no pose yet, or something else than sightings.
        """
        for sighting in sightings:
            expect("sighting", sighting, Sighting)
        if not self._stamps:
            raise InputError("no pose to measure from: begin one with add_odometry")
        if self._floating:
            found = locate(sightings, self._graph.map())
            if found is None:
                self._counts["pending"] += len(sightings)
                return [Outcome("pending", None, "where this is in the map is not clear") for _ in sightings]
            T_world_lidar, chosen = found
            self._graph.begin_at(len(self._poses), self._stamps[-1], T_world_lidar)
            self._poses.append(T_world_lidar)
        else:
            chosen = self._associate(sightings) if self._graph.landmarks else [None] * len(sightings)
        newest, paired = len(self._poses) - 1, [pairing for pairing in chosen if pairing is not None]
        borne = self._graph.add_matches([
            (Match(newest, p.landmark, sightings[p.sighting], p.hypothesis), p.T_target_lidar, p.summary)
            for p in paired
        ])  # fmt: skip
        if newest not in self._graph:
            self._poses.pop()  # it floats on
            return [Outcome("rejected", None if p is None else p.landmark, SINGULAR) for p in chosen]
        outcomes: list[Outcome | None] = [None] * len(sightings)
        for pairing in paired:
            name = pairing.landmark
            outcomes[pairing.sighting] = Outcome("matched", name) if borne else Outcome("rejected", name, SINGULAR)
            self._seen_now.add((name, sightings[pairing.sighting].lidar))
        result = []
        for sighting, outcome in zip(sightings, outcomes, strict=True):
            became = outcome or self._again(sighting) or self._candidates.carry(newest, sighting)
            if became.verdict == "new" and became.landmark is not None:
                self._seen_now.add((became.landmark, sighting.lidar))
            result.append(became)
        self._counts.update(outcome.verdict for outcome in result)
        if len(self._poses) % LOOK_EVERY == 0:
            self._graph.look_again()
        return result

    def settle(self) -> None:
        """Bring all linearisations up to date: after a loop was closed, updates do so only bit by bit."""
        self._graph.settle()

    # ---- out ---------------------------------------------------------------------------------------------------------

    @property
    def counts(self) -> Counter[str]:
        """Number of sightings by what became of them, and of landmarks that others have outvoted."""
        outvoted = self._candidates.outvoted
        return self._counts + Counter({"landmarks outvoted": outvoted})

    @property
    def pose(self) -> Floats:
        """(4, 4) T_world_lidar of the newest pose.

        Raises:
            EstimationError: nothing says yet where it is.
        """
        if not self._poses or self._floating:
            raise EstimationError("where the newest pose is in the map is not known")
        return self._graph.T_world_lidar(len(self._poses) - 1)

    @property
    def trajectory(self) -> Trajectory:
        """All poses; those that a lag has marginalised as they were estimated last."""
        self._poses = [
            self._graph.T_world_lidar(k) if k in self._graph else before for k, before in enumerate(self._poses)
        ]
        n = len(self._poses)
        return Trajectory(np.array(self._poses).reshape(-1, 4, 4), np.array(self._stamps[:n]), self.name)

    @property
    def landmarks(self) -> dict[str, Floats]:
        """T_world_target (4, 4) of each landmark."""
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
        return self._graph.covariance_with_biases(landmarks, poses)

    def map(self) -> Map:
        """Return the map as it is."""
        earlier = {} if self._known is None else dict(self._known.trajectories)
        return replace(self._graph.map(), trajectories=earlier | {self.name: self.trajectory})

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
            self.name, trajectory.stamps, trajectory.poses, self._graph.odometry, self._graph.matches, self._start
        )
        targets = {name: landmark.target for name, landmark in self._graph.landmarks.items()}
        return MappingProblem((track,), targets, self.landmarks, self._known)

    # ---- what is what ------------------------------------------------------------------------------------------------

    @property
    def _floating(self) -> bool:
        """Whether nothing says where the newest pose is."""
        return len(self._stamps) > len(self._poses)

    def _again(self, sighting: Sighting) -> Outcome | None:
        """Turn a sighting down that is of a landmark which its LiDAR saw from this pose already."""
        place = (self.pose @ sighting.T_lidar_target())[:3, 3]
        for name in self._graph.within(place, sighting.target.circumradius) if self._seen_now else ():
            if (name, sighting.lidar) in self._seen_now:
                return Outcome("rejected", name, "another sighting from this pose is of that landmark")
        return None

    def _associate(self, sightings: Sequence[Sighting]) -> list[Pairing | None]:
        newest = len(self._poses) - 1
        now = self._graph.T_world_lidar(newest)
        pairings = predictions(sightings, [self._possible(sighting, now) for sighting in sightings], now)
        if not pairings:
            return [None] * len(sightings)
        motion = self._graph.pending
        if motion is not None:
            certain = plain(pairings, len(sightings), motion.covariance)
            if certain is not None:
                return certain
        order = {name: k for k, name in enumerate(dict.fromkeys(pairing.landmark for pairing in pairings))}
        covariance = self._graph.covariance(list(order), [newest])
        return associate(gated(pairings, covariance, order), len(sightings), covariance, order)

    def _possible(self, sighting: Sighting, T_world_lidar: Floats) -> dict[str, Floats]:
        """Return the landmarks that a sighting may be of: the one it names, or those of its template nearby."""
        name = sighting.landmark
        if name is not None:
            possible = {name: self._graph.T_world_target(name)} if name in self._graph.landmarks else {}
        else:
            possible = self._graph.near(sighting, T_world_lidar)
        return {name: T for name, T in possible.items() if (name, sighting.lidar) not in self._seen_now}
