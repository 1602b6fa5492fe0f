"""The masses of modes, by importance sampling from a mixture of Student-t components over all of them.

Unknowns: a pose, and one scalar that all measurements share. A component has its own base pose, about which poses are
rotation vectors and translations in the base's own axes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, logsumexp
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.se3 import skew

FREEDOM = 5.0
"""Degrees of freedom of the components: their tails are heavy."""

SAMPLES = 1024
"""Poses that are drawn in each round."""

ROUNDS = (2, 5)
"""Rounds at least, and at most while the samples are worth few."""

ENOUGH = 100.0
"""Effective samples that are worth no further round."""

NEW = 4
"""Components that a round adds at most."""

LogDensity = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True, eq=False)
class Components:
    """A mixture over poses and one scalar.

    Attributes:
        T: (C, 4, 4) base poses.
        mean: (C, 7) rotation vector, rad, translation, metres, in the base's axes, and the scalar.
        covariance: (C, 7, 7).
        weight: (C,) sum to 1.
    """

    T: Floats
    mean: Floats
    covariance: Floats
    weight: Floats


@dataclass(frozen=True, eq=False)
class Samples:
    """Weighted poses.

    Attributes:
        T: (S, 4, 4).
        scalar: (S,)
        weight: (S,) sum to 1.
        log_evidence: logarithm of the integral of the density.
        effective: number of independent samples that they are worth.
    """

    T: Floats
    scalar: Floats
    weight: Floats
    log_evidence: float
    effective: float


def sample(log_density: LogDensity, components: Components, rng: np.random.Generator) -> Samples:
    """Integrate a density over poses T (S, 4, 4) and scalars (S,), refitting the components to it."""
    for number in range(ROUNDS[1]):
        T, scalar, roots = _draw(components, rng)
        logs, charts = _log_components(components, roots, T, scalar)
        log_weight = log_density(T, scalar) - logsumexp(logs, axis=0)
        total = float(logsumexp(log_weight))
        if not np.isfinite(total):
            return Samples(T, scalar, np.full(len(T), 1 / len(T)), -np.inf, 0.0)
        weight = np.exp(log_weight - total)
        result = Samples(T, scalar, weight, total - np.log(len(T)), 1.0 / float((weight**2).sum()))
        if number + 1 >= ROUNDS[0] and result.effective > ENOUGH:
            break
        share = np.exp(logs - logsumexp(logs, axis=0)) * weight
        components = _refit(components, share, charts)
    return result


def _draw(components: Components, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    count = rng.multinomial(SAMPLES, components.weight)
    which = np.repeat(np.arange(len(count)), count)
    roots = np.linalg.cholesky(components.covariance)
    normal = rng.standard_normal((SAMPLES, 7)) / np.sqrt(rng.chisquare(FREEDOM, SAMPLES) / FREEDOM)[:, None]
    xi = components.mean[which] + np.einsum("sij,sj->si", roots[which], normal)
    base = components.T[which]
    T = base.copy()
    T[:, :3, :3] = base[:, :3, :3] @ _exp(xi[:, :3])
    T[:, :3, 3] += np.einsum("sij,sj->si", base[:, :3, :3], xi[:, 3:6])
    return T, xi[:, 6], roots


def _exp(w: Floats) -> Floats:
    """(S, 3, 3) rotations of rotation vectors (S, 3)."""
    angle = np.linalg.norm(w, axis=1)
    half = np.sinc(angle / (2 * np.pi))
    W = skew(w)
    return np.eye(3) + np.sinc(angle / np.pi)[:, None, None] * W + 0.5 * (half**2)[:, None, None] * (W @ W)


def _log_components(components: Components, roots: Floats, T: Floats, scalar: Floats) -> tuple[Floats, Floats]:
    """Logarithm (C, S) of weight times density of each component, and where it has each sample (C, S, 7)."""
    base, turned = (Rotation.from_matrix(X[:, :3, :3]).as_quat() for X in (components.T, T))
    rotation = _rotation_vectors(base, turned)
    moved = np.einsum("cji,csj->csi", components.T[:, :3, :3], T[None, :, :3, 3] - components.T[:, None, :3, 3])
    charts = np.concatenate([rotation, moved, np.broadcast_to(scalar, moved.shape[:2])[..., None]], axis=-1)
    white = np.linalg.solve(roots, np.swapaxes(charts - components.mean[:, None], 1, 2))
    squared = (white**2).sum(axis=1)
    angle = np.linalg.norm(rotation, axis=-1)
    volume = 2 * np.log(np.sinc(angle / (2 * np.pi)))
    constant = gammaln((FREEDOM + 7) / 2) - gammaln(FREEDOM / 2) - 3.5 * np.log(FREEDOM * np.pi)
    scale = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
    log = constant - scale[:, None] - 0.5 * (FREEDOM + 7) * np.log1p(squared / FREEDOM) - volume
    with np.errstate(divide="ignore"):
        return log + np.log(components.weight)[:, None], charts


def _rotation_vectors(base: Floats, turned: Floats) -> Floats:
    """(C, S, 3) rotation vectors from quaternions (C, 4) to (S, 4), scalar last, in the axes of the former."""
    v, w = base[:, :3], base[:, 3]
    left = np.zeros((len(base), 4, 4))  # of the conjugate, so that left @ turned is the relative quaternion
    left[:, :3, :3] = w[:, None, None] * np.eye(3) - skew(v)
    left[:, :3, 3], left[:, 3, :3], left[:, 3, 3] = -v, v, w
    q = turned @ np.swapaxes(left, 1, 2)
    q *= np.where(q[..., 3:] < 0, -1.0, 1.0)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    return np.asarray(q[..., :3] * (2 * np.arctan2(sine, q[..., 3:]) / np.maximum(sine, 1e-300)))


def _refit(components: Components, share: Floats, charts: Floats) -> Components:
    """Move each component to the samples that are its own, as far as they are worth enough."""
    mass = share.sum(axis=1)
    mean, covariance = components.mean.copy(), components.covariance.copy()
    for c in np.flatnonzero(mass > 1e-6):
        p = share[c] / mass[c]
        effective = 1.0 / (p**2).sum()
        new = p @ charts[c]
        off = charts[c] - new
        spread = (p[:, None] * off).T @ off
        trust = effective / (effective + 30.0)
        mean[c] += trust * (new - mean[c])
        covariance[c] = trust * spread * 1.2 + (1 - trust) * covariance[c]
    weight = 0.9 * mass / mass.sum() + 0.1 / len(mass)
    # A sample that weighs much on its own lies where no component is: it becomes one.
    heavy = np.argsort(-share.sum(axis=0))[:NEW]
    heavy = heavy[share.sum(axis=0)[heavy] > 2.0 / ENOUGH]
    owner = share[:, heavy].argmax(axis=0)
    born = share.sum(axis=0)[heavy]
    return Components(
        np.concatenate([components.T, components.T[owner]]),
        np.concatenate([mean, charts[owner, heavy]]),
        np.concatenate([covariance, components.covariance[owner] / 4]),
        np.concatenate([weight, 0.5 * born]) / (1.0 + 0.5 * born.sum()),
    )
