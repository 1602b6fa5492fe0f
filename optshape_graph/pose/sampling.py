"""The evidence of a mode by importance sampling.

Expectation propagation takes the chords that rings cut out of the target for linear in the pose, and each ring to leave
by one given edge. Far away, where few rings meet the target and its orientation is known to many degrees, neither
holds, and modes are compared by numbers that are off by several units of log likelihood. Here poses are drawn about a
mode, and the likelihood of each is worked out as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import gammaln, logsumexp

from optshape_graph._arrays import Floats, Value
from optshape_graph.factors.se3 import inverse, inverse_covariance, skew
from optshape_graph.pose.likelihood import Firings, scan_log_likelihood
from optshape_graph.pose.propagation import Problem

SAMPLES = 1024
"""Poses that are drawn about a mode, in each round."""

ROUNDS = (2, 5)
"""Rounds at least, and at most where the samples are worth few."""

_FREEDOM = 6.0  # degrees of freedom of the t distribution that poses are drawn from: its tails are heavy
_WIDENING = 1.3  # of the posterior's standard deviations
_ENOUGH = 100  # effective samples


@dataclass(frozen=True, eq=False, repr=False)
class SampledMode(Value):
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
    angle = np.linalg.norm(xi[:, :3], axis=1)
    half = np.sinc(angle / (2 * np.pi))  # 2 sin(angle / 2) / angle
    W = skew(xi[:, :3])
    poses = np.tile(np.eye(4), (len(xi), 1, 1))
    turn = np.eye(3) + np.sinc(angle / np.pi)[:, None, None] * W + 0.5 * (half**2)[:, None, None] * (W @ W)
    poses[:, :3, :3] = T[:3, :3] @ turn
    poses[:, :3, 3] = T[:3, 3] + xi[:, 3:] @ T[:3, :3].T
    return poses, 2 * np.log(np.abs(half) + 1e-300)
