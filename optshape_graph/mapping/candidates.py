"""Candidates: what may become a landmark, carried outside the graph until several sightings agree on what it is.

A first sighting may be of something else, or leave several poses open. A second one, from elsewhere, tells: under the
right hypotheses both put the target in the same place. What is carried costs the graph nothing, and a wrong name or
pose never enters it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import gtsam
import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.factors.summary import Summary
from optshape_graph.mapping.association import gate
from optshape_graph.mapping.track import Sighting
from optshape_graph.se3 import adjoint, inverse

RESOLVED = 13.8
"""Difference of twice the log likelihood (a factor of 1000) from which on one hypothesis has beaten another."""

MOST_CARRIED = 200
"""How many candidates are carried; of more, those not seen for longest are given up."""

PosePair = Callable[[int, int], tuple[Floats, Floats, Floats]]
"""Numbers of two LiDAR poses to both (4, 4), and their joint covariance (12, 12)."""


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

    def takes(self, pose: int, sighting: Sighting, poses: PosePair) -> bool:
        """Add a sighting if it agrees with the first one under some of their hypotheses; say whether."""
        first_pose, first = self.sightings[0]
        if pose == self.latest or sighting.landmark != self.landmark or sighting.target.name != first.target.name:
            return False
        T_a, T_b, covariance = poses(first_pose, pose)
        distances = np.array([
            [_disagreement(first.summaries[choice[0]], b, T_a, T_b, covariance) for b in sighting.summaries]
            for choice in self.choices
        ])  # fmt: skip
        if distances.min() > gate(6):
            return False
        self.scores = self.scores + distances.min(axis=1)
        for choice, best in zip(self.choices, distances.argmin(axis=1), strict=True):
            choice.append(int(best))
        self.sightings.append((pose, sighting))
        return True

    def resolved(self) -> list[int] | None:
        """Return the hypothesis of every sighting, or None while more than one way to take them is left."""
        order = np.argsort(self.scores)
        if len(order) > 1 and self.scores[order[1]] - self.scores[order[0]] < RESOLVED:
            return None
        return self.choices[order[0]]


def _disagreement(a: Summary, b: Summary, T_a: Floats, T_b: Floats, covariance: Floats) -> float:
    """Squared Mahalanobis distance between where two sightings put a target, LiDAR poses T_world_lidar T_a and T_b.

    W = H_a T_a^-1 T_b H_b^-1 is the identity if they agree. There, right perturbations of H_a and T_b move it by
    Ad(H_a) and Ad(H_b), those of T_a and H_b by -Ad(H_a) and -Ad(H_b).
    """
    W = a.T_target_lidar @ inverse(T_a) @ T_b @ inverse(b.T_target_lidar)
    step = gtsam.Pose3.Logmap(gtsam.Pose3(W))
    Ad_a, Ad_b = adjoint(a.T_target_lidar), adjoint(b.T_target_lidar)
    J = np.hstack([-Ad_a, Ad_b])
    by_a, by_b = Ad_a @ np.linalg.inv(a.sqrt_information), Ad_b @ np.linalg.inv(b.sqrt_information)
    C = J @ covariance @ J.T + by_a @ by_a.T + by_b @ by_b.T
    return float(step @ np.linalg.solve(C, step))
