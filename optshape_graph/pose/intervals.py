"""The edge model: a boundary lies somewhere within an interval, known up to Gaussian noise.

A ring's last return lies inside the true edge by an azimuth that is uniform over one step: the phase of the firing.
A few lie elsewhere (returns lost at the edge, mixed pixels), so the interval is a mixture of two uniforms. Given what
all other measurements say of the boundary, a Gaussian, the moments of what they say together are those of
truncated Gaussians.
"""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr

from optshape_graph._arrays import Floats

_LOG_SQRT_2PI = 0.5 * np.log(2 * np.pi)


def truncated_moments(mean: Floats, variance: Floats, lower: Floats, upper: Floats) -> tuple[Floats, Floats, Floats]:
    """Moments of Gaussians truncated to intervals, stable far in the tails.

    Args:
        mean: (...) of the Gaussian, in any unit.
        variance: (...) of the Gaussian, in that unit squared.
        lower: (...) end of the interval, in that unit.
        upper: (...) end of the interval, in that unit, not below `lower`.

    Returns:
        Logarithm of the mass inside, mean and variance of the truncated Gaussian, each (...), in those units.
    """
    sd = np.sqrt(variance)
    a, b = (lower - mean) / sd, (upper - mean) / sd
    right = a > 0  # mirror, so that the interval is never in the upper tail
    a, b = np.where(right, -b, a), np.where(right, -a, b)
    log_a, log_b = log_ndtr(a), log_ndtr(b)
    width = b - a
    with np.errstate(all="ignore"):
        log_mass = log_b + np.log1p(-np.exp(log_a - log_b))
        density_a = np.exp(-0.5 * a * a - _LOG_SQRT_2PI - log_mass)
        density_b = np.exp(-0.5 * b * b - _LOG_SQRT_2PI - log_mass)
        m = density_a - density_b
        v = 1.0 + np.where(np.isfinite(a), a * density_a, 0.0) - b * density_b - m * m
    # Far out the density is exponential; in a narrow interval it is uniform, which is the same with a small rate.
    far = (b < -300) | (width < 1e-3) | ~np.isfinite(log_mass) | ~(v > 0)
    m, v = np.clip(m, a, b), np.minimum(v, width**2 / 4)
    if far.any():
        start, end, span = a[far], b[far], width[far]
        rate = np.maximum(-0.5 * (np.maximum(start, end - 1.0) + end), 0.0)
        tail_mean, v[far] = _exponential_moments(rate, span)
        m[far] = end - tail_mean
        flat_mass = np.log(np.maximum(span, 1e-300)) - 0.125 * (start + end) ** 2 - _LOG_SQRT_2PI
        log_mass[far] = np.where(np.isfinite(log_mass[far]) & (span >= 1e-3), log_mass[far], flat_mass)
    return log_mass, mean + sd * np.where(right, -m, m), variance * v


def _exponential_moments(rate: Floats, width: Floats) -> tuple[Floats, Floats]:
    """Mean and variance of the exponential density of a rate on [0, width]; uniform where rate * width is small."""
    x = rate * width
    flat = x < 1e-2
    safe = np.where(flat, 1.0, x)
    end = 1.0 / np.expm1(np.minimum(safe, 700.0))
    mean = np.where(flat, width * (0.5 - x / 12), width * (1.0 / safe - end))
    variance = np.where(flat, width**2 / 12, width**2 * (1.0 / safe**2 - end * (1.0 + end)))
    return mean, np.maximum(variance, 1e-300)


def mixture_moments(
    mean: Floats, variance: Floats, lower: Floats, upper: Floats, log_density: Floats
) -> tuple[Floats, Floats, Floats]:
    """Moments of a Gaussian times a mixture of uniform densities.

    Args:
        mean: (...) of the Gaussian, in any unit.
        variance: (...) of the Gaussian, in that unit squared.
        lower: (K, ...) lower ends of the K intervals, in that unit.
        upper: (K, ...) upper ends, in that unit.
        log_density: (K, ...) logarithm of each uniform's weight divided by its width.

    Returns:
        Logarithm of the normaliser, mean and variance of the product, each (...), in those units.
    """
    log_mass, m, v = truncated_moments(mean[None], variance[None], lower, upper)
    log_weight = log_density + log_mass
    top = log_weight.max(axis=0)
    weight = np.exp(log_weight - top)
    total = weight.sum(axis=0)
    weight /= total
    mixed = (weight * m).sum(axis=0)
    spread = (weight * (v + (m - mixed) ** 2)).sum(axis=0)
    return top + np.log(total), mixed, spread
