"""Candidates for the pose: ranked, and gathered in modes, poses that are the same but for their uncertainty.

Expectation propagation takes the chords that rings cut out of the target for linear in the pose, and each ring to leave
by one given edge. Far away, where few rings meet the target and its orientation is known to many degrees, neither
holds, and modes are compared by numbers that are off by several units of log likelihood. So where the likelihood itself
is known, of beams without width, poses are drawn about each mode and the likelihood of each is worked out as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.special import gammaln, logsumexp

from optshape_graph._arrays import Bools, Floats
from optshape_graph.edges import EdgePoints
from optshape_graph.errors import EstimationError
from optshape_graph.pose.likelihood import (
    Firings,
    alternative_labels,
    exit_probability,
    missed_rings,
    scan_log_likelihood,
)
from optshape_graph.pose.propagation import Posterior, Problem, concatenate, propagate
from optshape_graph.scan import Scan
from optshape_graph.se3 import difference, inverse, inverse_covariance, rotation, transform
from optshape_graph.target import Target

MOST_MODES = 4
"""Modes that are compared by samples."""

FEW_RINGS = 8
"""Rings up to which the half turn of the best pose is looked at, should no association have led there."""

COMPETING = 25.0
"""Difference of log likelihoods by association from which on a mode is not in the running."""

ALTERNATIVES = 6
"""How many associations next to the best take part in the estimate."""


SAMPLES = 1024
"""Poses that are drawn about a mode, in each round."""

ROUNDS = (2, 5)
"""Rounds at least, and at most where the samples are worth few."""

_FREEDOM = 6.0  # degrees of freedom of the t distribution that poses are drawn from: its tails are heavy
_WIDENING = 1.3  # of the posterior's standard deviations
_ENOUGH = 100  # effective samples


@dataclass(frozen=True, eq=False)
class Modes:
    """The best mode, and what else it might be.

    Attributes:
        candidates: best first; those of the best mode before all others.
        best: (C,) whether each is of the best mode.
        margin: difference of log likelihoods between the best mode, all its associations together, and the next;
            infinite where there is no other.
        rival: (4, 4) T_lidar_target of the next, or None.
    """

    candidates: Posterior
    best: Bools
    margin: float = np.inf
    rival: Floats | None = None

    @property
    def weights(self) -> Floats:
        """(C,) probability of each association, within the best mode; those below a thousandth count as 0."""
        score = self.candidates.log_likelihood
        weight = np.where(self.best, np.exp(np.minimum(score - score[0], 0.0)), 0.0)
        weight[weight < 1e-3] = 0.0
        return np.asarray(weight / weight.sum())

    @property
    def log_likelihood(self) -> float:
        """Log likelihood of the best mode, all its associations together."""
        return float(np.logaddexp.reduce(self.candidates.log_likelihood[self.best]))


def rank(problem: Problem, starts: Floats, scan: Scan, ends: EdgePoints) -> Posterior:
    """Find the posterior about each start, likeliest first, each association once.

    A first round tells the starts apart. A second works out the best and the associations next to it.

    Args:
        problem: one target in one scan.
        starts: (C, 4, 4) T_target_lidar.
        scan: the returns.
        ends: both ends of each ring.

    Raises:
        EstimationError: no pose explains the returns.
    """
    first = _judged(propagate(problem, starts, relinearisations=1, sweeps=2), problem, scan, ends)
    best = first.select(slice(0, 1))
    labels = np.vstack([best.geometry.labels, alternative_labels(problem, best, ALTERNATIVES)])
    T = np.repeat(best.T_target_lidar, len(labels), axis=0)
    second = _judged(propagate(problem, T, relinearisations=1, labels=labels, sweeps=4), problem, scan, ends)
    return _distinct(concatenate(second, first))


def _judged(posterior: Posterior, problem: Problem, scan: Scan, ends: EdgePoints) -> Posterior:
    """Add to the likelihoods what the posteriors leave out; likeliest first."""
    score = posterior.log_likelihood + exit_probability(problem, posterior)
    if scan.sensor is not None:
        score = score + missed_rings(problem, posterior, ends, scan.sensor)
    score = np.where(np.isfinite(score), score, -np.inf)
    if not np.isfinite(score).any():
        raise EstimationError(f"{scan.name}: no pose explains the returns")
    return _distinct(replace(posterior, log_likelihood=score))


def _distinct(posterior: Posterior) -> Posterior:
    """Each association once, as first listed; likeliest first."""
    firsts: dict[bytes, int] = {}
    for k, labels in enumerate(posterior.geometry.labels):
        firsts.setdefault(labels.tobytes(), k)
    index = np.array(list(firsts.values()))
    return posterior.select(index[np.argsort(-posterior.log_likelihood[index], kind="stable")])


def compare_modes(candidates: Posterior, problem: Problem, scan: Scan, ends: EdgePoints) -> Modes:
    """Gather candidates in modes, and compare the best with the next.

    Args:
        candidates: best first.
        problem: one target in one scan.
        scan: the returns.
        ends: both ends of each ring, on the grid of firings.
    """
    # The likelihood itself is known of beams without width; a beam's own scatter is in the posteriors alone.
    if problem.noise.ideal and not ends.scatter.any():
        return modes_by_samples(candidates, problem, Firings.of(ends, scan, problem.noise.options))
    return modes_by_association(candidates, problem.target)


def modes_by_association(candidates: Posterior, target: Target) -> Modes:
    """Take the likelihoods of the associations for what they are; the rival is the best outside the best's mode."""
    best = same_mode(candidates, target)
    others = np.flatnonzero(~best)
    if not len(others):
        return Modes(candidates, best)
    score = candidates.log_likelihood
    rival = others[score[others].argmax()]
    margin = float(np.logaddexp.reduce(score[best]) - score[rival])
    return Modes(candidates, best, margin, inverse(candidates.T_target_lidar[rival]))


def modes_by_samples(candidates: Posterior, problem: Problem, firings: Firings) -> Modes:
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
        first = candidates.select(np.flatnonzero(members)[:1])
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
        best = candidates.select(np.flatnonzero(found[0][1])[:1])
        turned = _half_turn(best.T_target_lidar, problem)
        mode = sample_mode(turned.T_target_lidar[0], turned.covariance[0], problem, firings)
        if not any(_meet(mode, other) for other, _ in found):
            alone = np.append(np.zeros(len(members), dtype=bool), True)
            candidates = concatenate(candidates, turned)
            found = [(other, np.append(members, False)) for other, members in found] + [(mode, alone)]
            found.sort(key=lambda entry: -entry[0].log_evidence)
    if len(found) < 2:
        return modes_by_association(candidates, problem.target)
    (winner, of_winner), (rival, _) = found[:2]
    order = np.argsort(~of_winner, kind="stable")
    margin = winner.log_evidence - rival.log_evidence
    return Modes(candidates.select(order), of_winner[order], margin, rival.T_lidar_target)


def _half_turn(T_target_lidar: Floats, problem: Problem) -> Posterior:
    """Posterior about a pose (1, 4, 4) turned upside down in its plane: the usual rival, where rings are few."""
    return propagate(problem, np.diag([1.0, -1.0, -1.0, 1.0]) @ T_target_lidar, relinearisations=4, sweeps=2)


def _groups(candidates: Posterior, target: Target) -> list[Bools]:
    """(C,) members of each mode that is in the running, best first."""
    left = candidates.log_likelihood > candidates.log_likelihood[0] - COMPETING
    groups: list[Bools] = []
    while left.any() and len(groups) < MOST_MODES:
        order = np.argsort(~left, kind="stable")
        members = np.zeros(len(left), dtype=bool)
        members[order] = same_mode(candidates.select(order), target)
        groups.append(members & left)
        left &= ~members
    return groups


def same_mode(posterior: Posterior, target: Target) -> Bools:
    """(C,) whether each pose belongs to the same mode as the first."""
    # Poses within a degree and a hundredth of the target are one pose, however sure each is of itself.
    size = target.circumradius
    floor = np.diag(np.array([0.02, 0.02, 0.02, 0.01 * size, 0.01 * size, 0.01 * size])) ** 2
    return _overlap(posterior.T_target_lidar, posterior.covariance, floor)


def _meet(a: SampledMode, b: SampledMode) -> bool:
    """Whether two modes are the same."""
    T, covariance = np.stack([a.T_lidar_target, b.T_lidar_target]), np.stack([a.covariance, b.covariance])
    return bool(_overlap(T, covariance)[1])


def _overlap(T: Floats, covariance: Floats, floor: Floats | float = 0.0) -> Bools:
    """(C,) whether each pose's region of 3 standard deviations meets the first's."""
    xi = difference(T[0], T)
    both = covariance + covariance[0] + floor
    return np.asarray(np.einsum("ci,ci->c", xi, np.linalg.solve(both, xi[..., None])[..., 0]) < 9.0)


@dataclass(frozen=True, eq=False)
class SampledMode:
    """What samples about a mode say of it.

    Attributes:
        log_evidence: logarithm of the mode's evidence, up to a constant of the scan.
        T_lidar_target: (4, 4) posterior mean.
        covariance: (6, 6) of its right perturbation, rotation first.
        effective: number of independent samples that the weighted ones are worth.
    """

    log_evidence: float
    T_lidar_target: Floats
    covariance: Floats
    effective: float


def sample_mode(T_target_lidar: Floats, covariance: Floats, problem: Problem, firings: Firings) -> SampledMode:
    """Work out the evidence of a mode.

    Args:
        T_target_lidar: (4, 4) about which it is.
        covariance: (6, 6) of its right perturbation, rotation first: about as wide as the mode.
        problem: one target in one scan.
        firings: of the same scan.
    """
    T = inverse(T_target_lidar)
    covariance = inverse_covariance(T_target_lidar, covariance)
    normal, squared = _draws()
    mean = np.zeros(6)
    result = SampledMode(-np.inf, T, covariance, 0.0)
    for number in range(ROUNDS[1]):
        if number >= ROUNDS[0] and result.effective > _ENOUGH:
            break
        root = np.linalg.cholesky(_WIDENING**2 * covariance)
        xi = mean + normal @ root.T
        log_density = -0.5 * (_FREEDOM + 6) * np.log1p(squared / _FREEDOM) - np.log(np.diag(root)).sum()
        poses, log_volume = _moved(T, xi)
        log_weight = scan_log_likelihood(poses, problem, firings) + log_volume - log_density
        log_total = float(logsumexp(log_weight))
        weight = np.exp(log_weight - log_total)
        effective = 1.0 / float((weight**2).sum())
        mean = weight @ xi
        covariance = (weight[:, None] * (xi - mean)).T @ (xi - mean)
        result = SampledMode(log_total - _LOG_NORMALISER, _moved(T, mean[None])[0][0], covariance, effective)
        if effective < 0.3 * _ENOUGH:
            covariance = covariance + root @ root.T / 4  # too few to tell the shape
    return result


_LOG_NORMALISER = float(
    np.log(SAMPLES) + gammaln((_FREEDOM + 6) / 2) - gammaln(_FREEDOM / 2) - 3 * np.log(_FREEDOM * np.pi)
)


@lru_cache(maxsize=1)
def _draws() -> tuple[Floats, Floats]:
    """Draws (S, 6) of a t distribution in six dimensions, the same in every call, and their squared lengths (S,)."""
    rng = np.random.default_rng(0)
    half = rng.standard_normal((SAMPLES // 2, 6))
    scale = np.sqrt(rng.chisquare(_FREEDOM, SAMPLES // 2) / _FREEDOM)
    draws = half / scale[:, None]
    draws = np.vstack([draws, -draws])
    draws.setflags(write=False)
    return draws, (draws**2).sum(axis=1)


def _moved(T: Floats, xi: Floats) -> tuple[Floats, Floats]:
    """Poses (S, 4, 4) moved from T by rotation vectors and translations xi (S, 6), in T's own axes.

    Returns:
        The poses, and the logarithm (S,) of how much volume of rotations a volume of rotation vectors covers there.
    """
    half = np.sinc(np.linalg.norm(xi[:, :3], axis=1) / (2 * np.pi))  # 2 sin(angle / 2) / angle
    poses = transform(T[:3, :3] @ rotation(xi[:, :3]), T[:3, 3] + xi[:, 3:] @ T[:3, :3].T)
    return poses, 2 * np.log(np.abs(half) + 1e-300)
