"""Candidates: what may become a landmark, carried outside the graph until several sightings agree on what it is.

A first sighting may be of something else, or leave several poses open. A second one, from elsewhere, tells: under the
right hypotheses both put the target in the same place. What is carried costs the graph nothing, and a wrong name or
pose never enters it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.factors.summary import Summary
from optshape_graph.mapping.association import gate
from optshape_graph.mapping.incremental_graph import IncrementalGraph
from optshape_graph.mapping.track import Match, Sighting
from optshape_graph.se3 import adjoint, inverse, log
from optshape_graph.target import Target

RESOLVED = 13.8
"""A hypothesis is dropped when another is a thousand times as likely: difference of twice the log likelihood."""

MOST_CARRIED = 200
"""How many candidates are carried; of more, those not seen for longest are given up."""

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


@dataclass(eq=False)
class Candidate:
    """Sightings of one thing.

    Attributes:
        sightings: number of the LiDAR pose, and what was seen from there.
        scores: (K,) for each measurement of the first sighting, how badly the others fit it: squared Mahalanobis
            distances.
        choices: for each of them, the hypothesis of every sighting.
    """

    sightings: list[tuple[int, Sighting]]
    scores: Floats = field(init=False)
    choices: list[list[int]] = field(init=False)

    def __post_init__(self) -> None:
        first = self.sightings[0][1]
        turns = len(first.target.symmetries)
        # How a symmetric target's vertices are named is free, once: the first sighting does it.
        self.choices = [[k * turns] for k in range(len(first.measurements))]
        self.scores = np.zeros(len(self.choices))

    @property
    def landmark(self) -> str | None:
        """The name of the landmark that the sightings are said to be of."""
        return self.sightings[0][1].landmark

    @property
    def latest(self) -> int:
        """Number of the LiDAR pose of the last sighting."""
        return self.sightings[-1][0]

    def is_of(self, pose: int, sighting: Sighting) -> bool:
        """Say whether it has a sighting from a pose by the same LiDAR in the same place."""
        latest_pose, latest = self.sightings[-1]
        apart = np.linalg.norm((latest.T_lidar_target() - sighting.T_lidar_target())[:3, 3])
        same = (pose, sighting.lidar, sighting.target.name) == (latest_pose, latest.lidar, latest.target.name)
        return same and bool(apart < sighting.target.circumradius)

    def takes(self, pose: int, sighting: Sighting, graph: IncrementalGraph) -> bool:
        """Add a sighting if it agrees with the first one under some of their hypotheses; say whether."""
        first_pose, first = self.sightings[0]
        if sighting.landmark != self.landmark or sighting.target.name != first.target.name:
            return False
        if (pose, sighting.lidar) in ((k, one.lidar) for k, one in self.sightings[-2:]):
            return False  # a LiDAR sees a thing once at a time
        if not self._near(pose, sighting, graph):
            return False
        distances = _disagreements(
            [first.summaries[choice[0]] for choice in self.choices],
            sighting.summaries,
            inverse(graph.T_world_lidar(first_pose)) @ graph.T_world_lidar(pose),
            graph.covariance(poses=[first_pose, pose]),
        )
        if distances.min() > gate(6):
            return False
        self.scores = self.scores + distances.min(axis=1)
        for choice, best in zip(self.choices, distances.argmin(axis=1), strict=True):
            choice.append(int(best))
        self.sightings.append((pose, sighting))
        return True

    def _near(self, pose: int, sighting: Sighting, graph: IncrementalGraph) -> bool:
        """Say whether odometry may have drifted by as much as a sighting seems to be off: its covariance costs more."""
        first_pose, first = self.sightings[0]
        before, now = (
            graph.T_world_lidar(k) @ inverse(np.array([summary.T_target_lidar for summary in one.summaries]))
            for k, one in ((first_pose, first), (pose, sighting))
        )
        distance = np.linalg.norm(now[:, :3, 3] - graph.T_world_lidar(pose)[:3, 3], axis=1).max()
        apart = np.linalg.norm(before[:, None, :3, 3] - now[:, :3, 3], axis=2).min()
        return bool(apart < graph.apart(first_pose, float(distance)) + 2.0 * first.target.circumradius)

    def resolved(self) -> list[int] | None:
        """Return the hypothesis of every sighting, or None while more than one way to take them is left."""
        order = np.argsort(self.scores)
        if len(order) > 1 and self.scores[order[1]] - self.scores[order[0]] < RESOLVED:
            return None
        return self.choices[order[0]]


class Candidates:
    """All candidates of a graph.

    Args:
        graph: where they become landmarks.
        confirmations: how many sightings must agree on one before that.

    Attributes:
        outvoted: number of landmarks that candidates with more sightings have replaced.
    """

    def __init__(self, graph: IncrementalGraph, confirmations: int) -> None:
        self.outvoted = 0
        self._graph = graph
        self._confirmations = confirmations
        self._carried: list[Candidate] = []
        self._made = Counter(landmark.target.name for landmark in graph.landmarks.values())

    def __len__(self) -> int:
        return len(self._carried)

    def carry(self, pose: int, sighting: Sighting) -> Outcome:
        """Keep a sighting that no landmark explains with the candidate that it agrees with, or as a new one.

        Args:
            pose: number of the LiDAR pose that it is from, in the graph.
            sighting: what was seen.
        """
        if not sighting.determined:
            return Outcome("rejected", sighting.landmark, "it determines no pose, and no known landmark explains it")
        self._carried = [c for c in self._carried if c.sightings[0][0] in self._graph]  # a lag forgets poses
        if any(c.is_of(pose, sighting) for c in self._carried):
            return Outcome("rejected", sighting.landmark, "another sighting from this pose is of the same target")
        candidate = next((c for c in self._carried if c.takes(pose, sighting, self._graph)), None)
        if candidate is None:
            candidate = Candidate([(pose, sighting)])
            self._carried = sorted([*self._carried, candidate], key=lambda c: c.latest)[-MOST_CARRIED:]
        choice = candidate.resolved()
        if choice is None or len(candidate.sightings) < self._confirmations:
            if sighting.landmark in self._graph.landmarks:
                return Outcome("rejected", sighting.landmark, "it is not where that landmark is")
            return Outcome("pending", sighting.landmark, "others must agree first")
        return self._promote(candidate, choice)

    def _promote(self, candidate: Candidate, choice: Sequence[int]) -> Outcome:
        """Make a landmark of a candidate, unless one that is known better contradicts it."""
        first_pose, first = candidate.sightings[0]
        T_world_target = self._graph.T_world_lidar(first_pose) @ inverse(first.summaries[choice[0]].T_target_lidar)
        rivals = self._rivals(candidate, T_world_target)
        strongest = max((self._graph.landmarks[name].observations for name in rivals), default=0)
        if rivals and (
            self._graph.lag is not None
            or len(candidate.sightings) <= strongest
            or any(self._graph.landmarks[name].surveyed for name in rivals)
        ):
            return Outcome(
                "rejected", candidate.landmark, f"landmark '{rivals[0]}' is known better, and contradicts it"
            )
        for name in rivals:
            self._graph.remove_landmark(name)
            self.outvoted += 1
        name = candidate.landmark or self._unused_name(first.target)
        matches = [
            Match(pose, name, sighting, hypothesis)
            for (pose, sighting), hypothesis in zip(candidate.sightings, choice, strict=True)
        ]
        self._carried.remove(candidate)
        self._made[first.target.name] += 1
        borne = self._graph.add_landmark(name, first.target, T_world_target, matches)
        return Outcome("new", name) if borne else Outcome("rejected", None, SINGULAR)

    def _rivals(self, candidate: Candidate, T_world_target: Floats) -> list[str]:
        """Return the landmarks that cannot be true together with a new one: of its name, or in its place."""
        _, first = candidate.sightings[0]
        place, radius = T_world_target[:3, 3], first.target.circumradius
        rivals = [candidate.landmark] if candidate.landmark in self._graph.landmarks else []
        for name, T in self._graph.within(place, radius).items():
            apart = np.linalg.norm(T[:3, 3] - place)
            if name not in rivals and apart < min(self._graph.landmarks[name].target.circumradius, radius):
                rivals.append(name)
        return rivals

    def _unused_name(self, target: Target) -> str:
        k = self._made[target.name]
        while f"{target.name}-{k}" in self._graph.landmarks:
            k += 1
        return f"{target.name}-{k}"


def _disagreements(a: Sequence[Summary], b: Sequence[Summary], T_a_b: Floats, covariance: Floats) -> Floats:
    """Squared Mahalanobis distances (K, S) between where sightings a and b, from two LiDAR poses, put a target.

    W = H_a T_a^-1 T_b H_b^-1 is the identity if they agree. There, right perturbations of H_a and T_b move it by
    Ad(H_a) and Ad(H_b), those of T_a and H_b by -Ad(H_a) and -Ad(H_b).
    """
    H_a, H_b = np.array([one.T_target_lidar for one in a])[:, None], np.array([one.T_target_lidar for one in b])
    step = log(H_a @ T_a_b @ inverse(H_b))
    Ad_a, Ad_b = np.broadcast_arrays(adjoint(H_a), adjoint(H_b))
    J = np.concatenate([-Ad_a, Ad_b], axis=-1)
    by_a = Ad_a @ np.linalg.inv([one.sqrt_information for one in a])[:, None]
    by_b = Ad_b @ np.linalg.inv([one.sqrt_information for one in b])
    C = J @ covariance @ np.swapaxes(J, -1, -2) + by_a @ np.swapaxes(by_a, -1, -2) + by_b @ np.swapaxes(by_b, -1, -2)
    return np.asarray((step * np.linalg.solve(C, step[..., None])[..., 0]).sum(axis=-1))
