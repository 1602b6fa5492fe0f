"""Integrals over poses by importance sampling from a mixture of Student-t components, refitted to what they found.

Unknowns: a pose T, and one scalar beside it. A component has its own base pose, about which a pose is a rotation vector
and a translation in the base's own axes. (Population Monte Carlo: Cappe, Douc, Guillin, Marin and Robert, Adaptive
importance sampling in general mixture classes, 2008.) Samples of all rounds are weighed against the mean of what the
rounds draw from, so that one that a bad round drew by luck weighs no more than one of a good round. (Cornuet, Marin,
Mira and Robert, Adaptive multiple importance sampling, 2012.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import lgamma

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.compiled import address, library
from optshape_graph.gaussian import logsumexp
from optshape_graph.se3 import inverse, quaternion, quaternions_from, rotation, transform, turns_between

FREEDOM = 5.0
"""Degrees of freedom of the components: their tails are heavy."""

SAMPLES = 1024
"""Poses that are drawn in each round."""

ROUNDS = (2, 5)
"""Rounds at least, and at most while the samples are worth few. A third for all moves margins near their limit by less
than another seed does: 0.15, standard deviation."""

ENOUGH = 200.0
"""Effective samples that are worth no further round."""

EVEN = 0.5
"""Share of the components' weight that is even, so that a mode of little mass is sampled too."""

FEW = 20.0
"""Effective samples that a component is refitted to at least."""

HEAVY = 0.02
"""Weight of a single sample that says that no component is where it lies."""

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
        covariance: (C, 7, 7) of each about its mean, in those units.
        weight: (C,) probability of each; they sum to 1.
    """

    T: Floats
    mean: Floats
    covariance: Floats
    weight: Floats

    @cached_property
    def roots(self) -> Floats:
        """(C, 7, 7) lower triangular roots of the covariances."""
        return np.asarray(np.linalg.cholesky(self.covariance))

    @cached_property
    def whitening(self) -> Floats:
        """(C, 7, 7) inverses of the roots."""
        return np.asarray(np.linalg.inv(self.roots))

    @cached_property
    def T_inverse(self) -> Floats:
        """(C, 4, 4) of the base poses."""
        return inverse(self.T)

    @cached_property
    def quaternions(self) -> Floats:
        """(C, 4, 4) what a pose's quaternion is multiplied by to be about the base."""
        return quaternions_from(self.T)

    @cached_property
    def log_peak(self) -> Floats:
        """(C,) logarithm of weight times density at the mean."""
        scale = np.log(np.diagonal(self.roots, axis1=1, axis2=2)).sum(axis=1)
        constant = lgamma((FREEDOM + 7) / 2) - lgamma(FREEDOM / 2) - 3.5 * np.log(FREEDOM * np.pi)
        return np.asarray(constant - scale + np.log(self.weight))


@dataclass(frozen=True, eq=False, repr=False)
class Draws(Value):
    """Poses that were drawn.

    Attributes:
        T: (S, 4, 4).
        scalar: (S,) beside each, in its own unit.
        quaternions: (S, K, 4) of unit length: rotations of T, and of what is the same by each symmetry.
    """

    T: Floats
    scalar: Floats
    quaternions: Floats

    def __add__(self, other: Draws) -> Draws:
        """Return both."""
        return Draws(*(np.concatenate([getattr(one, name) for one in (self, other)]) for name in vars(self)))


@dataclass(frozen=True, eq=False, repr=False)
class Samples(Value):
    """Weighted poses.

    Attributes:
        T: (S, 4, 4).
        scalar: (S,) beside each, in its own unit.
        weight: (S,) probability of each; they sum to 1.
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


def sample(log_density: LogDensity, components: Components, symmetries: Floats, rng: np.random.Generator) -> Samples:
    """Draw from the components, weigh by the density, and refit them, until the samples are worth enough.

    The samples of all rounds count.

    Args:
        log_density: of poses and scalars, the same at T and T S for every symmetry S.
        components: to begin with.
        symmetries: (K, 4, 4) S; the identity alone where there is no other.
        rng: source of randomness.
    """
    drawn, log_target = Draws(np.zeros((0, 4, 4)), np.zeros(0), np.zeros((0, len(symmetries), 4))), np.zeros(0)
    rounds: list[Components] = []
    log_drawn = np.zeros((0, 0))  # of each round's components, at each sample
    for number in range(ROUNDS[1]):
        new = _draw(components, symmetries, rng)
        before = [logsumexp(_log_components(old, new)[0], axis=0) for old in rounds]
        drawn, log_target = drawn + new, np.concatenate([log_target, log_density(new.T, new.scalar)])
        rounds.append(components)
        logs, charts = _log_components(components, drawn)
        earlier = np.hstack([log_drawn, np.reshape(before, (number, len(new.T)))])
        log_drawn = np.vstack([earlier, logsumexp(logs, axis=0)])
        log_weight = log_target - (logsumexp(log_drawn, axis=0) - np.log(len(rounds)))
        total = float(logsumexp(log_weight))
        samples = Samples(drawn.T, drawn.scalar, np.exp(log_weight - total), total - np.log(len(drawn.T)))
        if number + 1 >= ROUNDS[0] and samples.effective > ENOUGH:
            break
        share = np.exp(logs - log_drawn[-1] + log_weight - total)
        components = _refitted(components, share, charts)
    return samples


def _draw(components: Components, symmetries: Floats, rng: np.random.Generator) -> Draws:
    """Draw poses and scalars from the components."""
    count = rng.multinomial(SAMPLES, components.weight)
    which = np.repeat(np.arange(len(count)), count)
    t = rng.standard_normal((SAMPLES, 7)) / np.sqrt(rng.chisquare(FREEDOM, SAMPLES) / FREEDOM)[:, None]
    xi = components.mean[which] + (components.roots[which] @ t[..., None])[..., 0]
    T = components.T[which] @ transform(rotation(xi[:, :3]), xi[:, 3:6])
    return Draws(T, xi[:, 6], quaternion(T[:, None, :3, :3] @ symmetries[:, :3, :3]))


def _log_components(components: Components, draws: Draws) -> tuple[Floats, Floats]:
    """Logarithm (C, S) of weight times density of each component, and where it has each sample (C, 7, S)."""
    base, log_peak = components.T_inverse, components.log_peak
    places = np.ascontiguousarray(draws.T[:, :3, 3].T)
    charts, compiled = np.empty((len(base), 7, len(draws.T))), library()
    if compiled is not None:
        log = np.empty((len(base), len(draws.T)))
        quaternions = draws.quaternions.transpose(1, 2, 0)
        arrays = components.quaternions, base[:, :3], components.whitening, components.mean, log_peak, quaternions
        laid = [np.ascontiguousarray(array) for array in (*arrays, places, draws.scalar)]
        counts = (len(base), len(draws.T), len(quaternions))
        compiled.log_components(*counts, *map(address, laid), FREEDOM, address(log), address(charts))
        return log, charts
    charts[:, :3], per_sine = turns_between(components.T, draws.quaternions)
    charts[:, 3:6] = base[:, :3, :3] @ places + base[:, :3, 3:]
    charts[:, 6] = draws.scalar
    white = components.whitening @ (charts - components.mean[..., None])
    squared = (white * white).sum(axis=1)
    # How much volume of rotations a volume of rotation vectors covers there: (2 sin(x / 2) / x)^2.
    volume = -2 * np.log(0.5 * per_sine)
    return log_peak[:, None] - 0.5 * (FREEDOM + 7) * np.log1p(squared / FREEDOM) - volume, charts


def _refitted(components: Components, share: Floats, charts: Floats) -> Components:
    """Move each component to the samples that are its own, (C, S) shares of weights.

    A component far from where the density is has one sample or two that weigh all: it follows a power of the weights,
    such that `FEW` count.
    """
    mass = share.sum(axis=1)
    mean, covariance = components.mean.copy(), components.covariance.copy()
    for c in np.flatnonzero(mass > 0):
        p, effective = _tempered(share[c] / share[c].max())
        new = charts[c] @ p
        off = charts[c] - new[:, None]
        trust = effective / (effective + FEW)
        mean[c] = new
        covariance[c] = trust * 1.2 * (p * off) @ off.T + (1 - trust) * covariance[c]
    weight = (1 - EVEN) * mass / mass.sum() + EVEN / len(mass)
    # A sample that weighs much on its own lies where no component is: it becomes one.
    weighs = share.sum(axis=0)
    heavy = np.argsort(-weighs)[:BORN]
    heavy = heavy[weighs[heavy] > HEAVY]
    owner, born = share[:, heavy].argmax(axis=0), 0.5 * weighs[heavy]
    return Components(
        np.concatenate([components.T, components.T[owner]]),
        np.concatenate([mean, charts[owner, :, heavy]]),
        np.concatenate([covariance, components.covariance[owner] / 4]),
        np.concatenate([weight, born]) / (1.0 + born.sum()),
    )


def _tempered(weight: Floats) -> tuple[Floats, float]:
    """Weights (S,) that sum to 1, a power of those given, and how many samples they are worth."""
    for power in (1.0, 0.5, 0.25, 0.125):
        p = weight**power
        p /= p.sum()
        effective = 1.0 / float((p**2).sum())
        if effective > FEW:
            break
    return p, effective
