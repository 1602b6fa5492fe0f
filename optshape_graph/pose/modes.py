"""Candidates for the pose, gathered in modes: poses that are the same but for their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.factors.se3 import inverse
from optshape_graph.pose.estimate import Ambiguity
from optshape_graph.pose.likelihood import Firings
from optshape_graph.pose.propagation import Posterior, Problem, concatenate, propagate
from optshape_graph.pose.sampling import SampledMode, sample_mode
from optshape_graph.target import Target

MOST_MODES = 4
"""Modes that are compared by samples."""

FEW_RINGS = 8
"""Rings up to which the half turn of the best pose is looked at, should no association have led there."""

COMPETING = 25.0
"""Difference of log likelihoods by association from which on a mode is not in the running."""


@dataclass(frozen=True, eq=False, repr=False)
class Candidates(Value):
    """Posteriors, each with its own association, and their log likelihoods, best first.

    Attributes:
        posterior: C of them.
        score: (C,) log likelihoods.
    """

    posterior: Posterior
    score: Floats

    def select(self, index: Ints) -> Candidates:
        """Return some of them, at indices (K,), in another order."""
        return Candidates(self.posterior.select(index), self.score[index])


@dataclass(frozen=True, eq=False, repr=False)
class Modes(Value):
    """The best mode, and what else it might be.

    Attributes:
        candidates: best first; those of the best mode before all others.
        best: (C,) whether each is of the best mode.
        ambiguity: margin between the best mode, all its associations together, and the next.
    """

    candidates: Candidates
    best: Bools
    ambiguity: Ambiguity


def modes_by_association(candidates: Candidates, target: Target) -> Modes:
    """Take the likelihoods of the associations for what they are; the rival is the best outside the best's mode."""
    best = same_mode(candidates.posterior, target)
    others = np.flatnonzero(~best)
    if not len(others):
        return Modes(candidates, best, Ambiguity(np.inf, None))
    score = candidates.score
    rival = others[score[others].argmax()]
    margin = float(np.logaddexp.reduce(score[best]) - score[rival])
    return Modes(candidates, best, Ambiguity(margin, inverse(candidates.posterior.T_target_lidar[rival])))


def modes_by_samples(candidates: Candidates, problem: Problem, firings: Firings) -> Modes:
    """Compare the modes that are in the running by samples of the likelihood itself.

    Args:
        candidates: best first.
        problem: one target in one scan.
        firings: of the same scan.
    """
    groups = _groups(candidates, problem.target)
    few = len(firings.left) <= FEW_RINGS and len(problem.target.symmetries) == 1
    if len(groups) < 2 and not few:
        return modes_by_association(candidates, problem.target)
    found: list[tuple[SampledMode, Bools]] = []
    for members in groups:
        first = candidates.posterior.select(np.flatnonzero(members)[:1])
        mode = sample_mode(first.T_target_lidar[0], first.covariance[0], problem, firings)
        # Samples may wander off to a mode that is there already.
        known = next((k for k, (other, _) in enumerate(found) if _meet(mode, other)), None)
        if known is None:
            found.append((mode, members))
        else:
            other, rest = found[known]
            found[known] = max(mode, other, key=lambda m: m.effective), rest | members
    found.sort(key=lambda entry: -entry[0].log_evidence)
    if few:
        best = candidates.posterior.select(np.flatnonzero(found[0][1])[:1])
        turned = _half_turn(best.T_target_lidar, problem)
        mode = sample_mode(turned.T_target_lidar[0], turned.covariance[0], problem, firings)
        if not any(_meet(mode, other) for other, _ in found):
            alone = np.append(np.zeros(len(candidates.score), dtype=bool), True)
            candidates = Candidates(
                concatenate(candidates.posterior, turned), np.append(candidates.score, turned.log_evidence)
            )
            found = [(other, np.append(members, False)) for other, members in found] + [(mode, alone)]
            found.sort(key=lambda entry: -entry[0].log_evidence)
    if len(found) < 2:
        return modes_by_association(candidates, problem.target)
    (winner, of_winner), (rival, _) = found[:2]
    order = np.argsort(~of_winner, kind="stable")
    ambiguity = Ambiguity(winner.log_evidence - rival.log_evidence, rival.T_lidar_target)
    return Modes(candidates.select(order), of_winner[order], ambiguity)


def _half_turn(T_target_lidar: Floats, problem: Problem) -> Posterior:
    """Posterior about a pose (1, 4, 4) turned upside down in its plane: the usual rival, where rings are few."""
    return propagate(problem, np.diag([1.0, -1.0, -1.0, 1.0]) @ T_target_lidar, relinearisations=4, sweeps=2)


def _groups(candidates: Candidates, target: Target) -> list[Bools]:
    """(C,) members of each mode that is in the running, best first."""
    left = candidates.score > candidates.score[0] - COMPETING
    groups: list[Bools] = []
    while left.any() and len(groups) < MOST_MODES:
        order = np.argsort(~left, kind="stable")
        members = np.zeros(len(left), dtype=bool)
        members[order] = same_mode(candidates.posterior.select(order), target)
        groups.append(members & left)
        left &= ~members
    return groups


def same_mode(posterior: Posterior, target: Target) -> Bools:
    """(C,) whether each pose belongs to the same mode as the first: their regions of 3 standard deviations meet."""
    T = posterior.T_target_lidar
    xi = log(inverse(T[0]) @ T)
    both = posterior.covariance + posterior.covariance[0]
    # Poses within a degree and a hundredth of the target are one pose, however sure each is of itself.
    size = target.circumradius
    floor = np.diag(np.array([1.0, 1.0, 1.0, size, size, size]) * np.array([0.02] * 3 + [0.01] * 3)) ** 2
    distance = np.einsum("ci,ci->c", xi, np.linalg.solve(both + floor, xi[..., None])[..., 0])
    return np.asarray(distance < 9.0)


def _meet(a: SampledMode, b: SampledMode) -> bool:
    """Whether two modes are the same, as `same_mode` has it."""
    xi = log((inverse(a.T_lidar_target) @ b.T_lidar_target)[None])[0]
    return bool(xi @ np.linalg.solve(a.covariance + b.covariance, xi) < 9.0)


def log(T: Floats) -> Floats:
    """Tangent vectors (C, 6), rotation first, of transforms (C, 4, 4)."""
    return np.array([gtsam.Pose3.Logmap(gtsam.Pose3(M)) for M in T])
