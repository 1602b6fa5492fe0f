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
        mean: (...) of the Gaussian.
        variance: (...) of the Gaussian.
        lower: (...) end of the interval.
        upper: (...) end of the interval, not below `lower`.

    Returns:
        Logarithm of the mass inside, mean and variance of the truncated Gaussian, each (...).
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
    # Where the interval is narrow against the Gaussian, the difference of two equal numbers: uniform.
    narrow = (width < 1e-3) | ~np.isfinite(log_mass) | ~np.isfinite(m) | ~(v > 0)
    middle = 0.5 * (a + b)
    with np.errstate(all="ignore"):
        log_mass = np.where(narrow, np.log(np.maximum(width, 1e-300)) - 0.5 * middle**2 - _LOG_SQRT_2PI, log_mass)
    m = np.where(narrow, middle, np.clip(m, a, b))
    v = np.where(narrow, width**2 / 12, np.minimum(v, width**2 / 4))
    return log_mass, mean + sd * np.where(right, -m, m), variance * v


def mixture_moments(
    mean: Floats, variance: Floats, lower: Floats, upper: Floats, log_density: Floats
) -> tuple[Floats, Floats, Floats]:
    """Moments of a Gaussian times a mixture of uniform densities.

    Args:
        mean: (...) of the Gaussian.
        variance: (...) of the Gaussian.
        lower: (K, ...) ends of the K intervals.
        upper: (K, ...) likewise.
        log_density: (K, ...) logarithm of each uniform's weight divided by its width.

    Returns:
        Logarithm of the normaliser, mean and variance of the product, each (...).
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
