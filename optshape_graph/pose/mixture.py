"""Integrals over poses by importance sampling from a mixture of Student-t components, refitted to what they found.

Unknowns: a pose T, and one scalar beside it. A component has its own base pose, about which a pose is a rotation vector
and a translation in the base's own axes. (Population Monte Carlo: Cappe, Douc, Guillin, Marin and Robert, Adaptive
importance sampling in general mixture classes, 2008.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import lgamma

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.gaussian import logsumexp
from optshape_graph.se3 import inverse, rotation, rotation_vector, transform

FREEDOM = 5.0
"""Degrees of freedom of the components: their tails are heavy."""

SAMPLES = 1024
"""Poses that are drawn in each round."""

ROUNDS = (2, 5)
"""Rounds at least, and at most while the samples are worth few."""

ENOUGH = 100.0
"""Effective samples that are worth no further round."""

BORN = 4
"""Components that a round adds at most."""

LogDensity = Callable[[Floats, Floats], Floats]
"""Of poses (S, 4, 4) and scalars (S,): the logarithm (S,) of a density."""


@dataclass(frozen=True, eq=False, repr=False)
class Components(Value):
    """A mixture over poses and one scalar.

    Attributes:
        T: (C, 4, 4) base poses.
        mean: (C, 7) rotation vector, rad, and translation, metres, in the base's axes; and the scalar.
        covariance: (C, 7, 7).
        weight: (C,) sum to 1.
    """

    T: Floats
    mean: Floats
    covariance: Floats
    weight: Floats


@dataclass(frozen=True, eq=False, repr=False)
class Samples(Value):
    """Weighted poses.

    Attributes:
        T: (S, 4, 4).
        scalar: (S,) beside each.
        weight: (S,) sum to 1.
        log_integral: logarithm of the density's integral.
    """

    T: Floats
    scalar: Floats
    weight: Floats
    log_integral: float

    @property
    def effective(self) -> float:
        """Number of independent samples that they are worth."""
        return float(self.weight.sum() ** 2 / (self.weight**2).sum())


def sample(log_density: LogDensity, components: Components, rng: np.random.Generator) -> Samples:
    """Draw from the components, weigh by the density, and refit them, until the samples are worth enough."""
    for number in range(ROUNDS[1]):
        T, scalar, roots = _draw(components, rng)
        logs, charts = _log_components(components, roots, T, scalar)
        log_drawn = logsumexp(logs, axis=0)
        log_weight = log_density(T, scalar) - log_drawn
        total = float(logsumexp(log_weight))
        samples = Samples(T, scalar, np.exp(log_weight - total), total - np.log(SAMPLES))
        if number + 1 >= ROUNDS[0] and samples.effective > ENOUGH:
            break
        components = _refitted(components, np.exp(logs - log_drawn) * samples.weight, charts)
    return samples


def _draw(components: Components, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Poses, scalars, and the roots of the covariances they were drawn with."""
    count = rng.multinomial(SAMPLES, components.weight)
    which = np.repeat(np.arange(len(count)), count)
    roots: Floats = np.asarray(np.linalg.cholesky(components.covariance))
    t = rng.standard_normal((SAMPLES, 7)) / np.sqrt(rng.chisquare(FREEDOM, SAMPLES) / FREEDOM)[:, None]
    xi = components.mean[which] + (roots[which] @ t[..., None])[..., 0]
    return components.T[which] @ transform(rotation(xi[:, :3]), xi[:, 3:6]), xi[:, 6], roots


def _log_components(components: Components, roots: Floats, T: Floats, scalar: Floats) -> tuple[Floats, Floats]:
    """Logarithm (C, S) of weight times density of each component, and where it has each sample (C, S, 7)."""
    from_base = inverse(components.T)[:, None] @ T
    turn = rotation_vector(from_base[..., :3, :3])
    charts = np.concatenate([turn, from_base[..., :3, 3], np.broadcast_to(scalar, turn.shape[:2])[..., None]], axis=-1)
    white = np.linalg.solve(roots, np.swapaxes(charts - components.mean[:, None], 1, 2))
    squared = (white**2).sum(axis=1)
    # How much volume of rotations a volume of rotation vectors covers there: (2 sin(x / 2) / x)^2.
    volume = 2 * np.log(np.sinc(np.linalg.norm(turn, axis=-1) / (2 * np.pi)))
    constant = lgamma((FREEDOM + 7) / 2) - lgamma(FREEDOM / 2) - 3.5 * np.log(FREEDOM * np.pi)
    scale = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
    log = constant - scale[:, None] - 0.5 * (FREEDOM + 7) * np.log1p(squared / FREEDOM) - volume
    return log + np.log(components.weight)[:, None], charts


def _refitted(components: Components, share: Floats, charts: Floats) -> Components:
    """Move each component to the samples that are its own, (C, S) shares of weights, as far as they are worth it."""
    mass = share.sum(axis=1)
    mean, covariance = components.mean.copy(), components.covariance.copy()
    for c in np.flatnonzero(mass > 1e-6):
        p = share[c] / mass[c]
        new = p @ charts[c]
        off = charts[c] - new
        effective = 1.0 / (p**2).sum()
        trust = effective / (effective + 30.0)  # about four samples for each of seven unknowns
        mean[c] += trust * (new - mean[c])
        covariance[c] = trust * 1.2 * (p[:, None] * off).T @ off + (1 - trust) * covariance[c]
    weight = 0.9 * mass / mass.sum() + 0.1 / len(mass)
    # A sample that weighs much on its own lies where no component is: it becomes one.
    weighs = share.sum(axis=0)
    heavy = np.argsort(-weighs)[:BORN]
    heavy = heavy[weighs[heavy] > 2.0 / ENOUGH]
    owner, born = share[:, heavy].argmax(axis=0), 0.5 * weighs[heavy]
    return Components(
        np.concatenate([components.T, components.T[owner]]),
        np.concatenate([mean, charts[owner, heavy]]),
        np.concatenate([covariance, components.covariance[owner] / 4]),
        np.concatenate([weight, born]) / (1.0 + born.sum()),
    )
