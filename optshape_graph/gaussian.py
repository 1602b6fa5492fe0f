"""The normal distribution in NumPy: logarithms of its tails, to rounding, and its moments within intervals.

SciPy has the same, but importing `scipy.special` takes longer than estimating a pose, and most runs estimate few.

With t = |x| / sqrt(2) the smaller tail is erfc(t) / 2 = exp(-t^2) S(t) / 2. The scaled tail S is smooth and falls like
1 / t: for all t >= 0, (1 + t) S(t) is one ratio of polynomials in y = (t - 3) / (t + 3), from -1 to 1 (the variable of
Shepherd and Laframboise, Math. Comp. 36, 1981; the coefficients are fitted to 2e-16 of S).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats

_SCALED_TAIL = (
    [2.0967984490337273e-05, 0.00046158934781906846, 0.0027177091311766993, 0.01673502829007334, 0.051309535107367105,
     0.1568048288724029, 0.3214472433183401, 0.5453248423610739, 0.8037742792108247, 0.658223448396614,
     0.7160046047255596],
    [7.126827717278987e-05, 0.0010393388326473947, 0.007475874675158582, 0.035061530751930664, 0.11963947760638417,
     0.3128720694016449, 0.6473388845332646, 1.0508068649859599, 1.3848016150950482, 1.2418227140050702, 1.0],
)  # fmt: skip

_LOG_SQRT_2PI = 0.5 * np.log(2 * np.pi)
_PEAK = np.exp(-_LOG_SQRT_2PI)


def ndtr(x: ArrayLike) -> Floats:
    """Return the probability (...) that a standard normal variable is below x (...), as a number."""
    x = np.asarray(x, float)
    t = np.abs(x) * np.sqrt(0.5)
    with np.errstate(under="ignore"):
        tail = 0.5 * np.exp(-t * t) * _scaled_tail(t)
    return np.asarray(np.where(x < 0.0, tail, 1.0 - tail))


def log_ndtr(x: ArrayLike) -> Floats:
    """Return the logarithm (...) of `ndtr`, a number that does not underflow."""
    x = np.asarray(x, float)
    t = np.abs(x) * np.sqrt(0.5)
    with np.errstate(under="ignore", over="ignore", divide="ignore"):
        scaled = 0.5 * _scaled_tail(t)
        return np.asarray(np.where(x < 0.0, np.log(scaled) - t * t, np.log1p(-scaled * np.exp(-t * t))))


def logsumexp(values: ArrayLike, axis: int | None = None) -> Floats:
    """Return the logarithm of the sum of exponentials of values (...), numbers, along an axis or of all of them."""
    values = np.asarray(values, float)
    top = np.max(values, axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore", under="ignore"):
        total = np.log(np.exp(values - top).sum(axis=axis, keepdims=True)) + top
    return np.asarray(np.squeeze(total, axis=axis))


def _scaled_tail(t: Floats) -> Floats:
    """Return S(t) = exp(t^2) erfc(t) for t >= 0."""
    y = 1.0 - 6.0 / (t + 3.0)
    top, bottom = _SCALED_TAIL
    return np.asarray(_polynomial(top, y) / (_polynomial(bottom, y) * (1.0 + t)))


def _polynomial(coefficients: list[float], x: Floats) -> Floats:
    """Return a polynomial at x (...), the highest power first, by Horner's rule in place."""
    value = x * coefficients[0]
    value += coefficients[1]
    for c in coefficients[2:]:
        value *= x
        value += c
    return value


def chi_square_tail(square: float, freedom: float) -> float:
    """Return the probability that a chi-square variable exceeds `square`, within a third of it; 1 without freedom.

    The cube root of the variable is close to normal (Wilson and Hilferty, Proc. Natl. Acad. Sci. 17, 1931).
    """
    if freedom <= 0:
        return 1.0
    spread = 2.0 / (9.0 * freedom)
    return _tail(((max(square, 0.0) / freedom) ** (1 / 3) - (1.0 - spread)) / math.sqrt(spread))


def f_tail(ratio: float, k: float, freedom: float) -> float:
    """Return the probability that an F variable of (k, freedom) degrees exceeds `ratio`, at most three times too large.

    The variable is a ratio of two whose cube roots are close to normal (Paulson, Ann. Math. Stat. 13, 1942). With fewer
    than three degrees of freedom the approximation fails, and 1 is returned.
    """
    if freedom < 3:
        return 1.0
    root, above, below = max(ratio, 0.0) ** (1 / 3), 2.0 / (9.0 * k), 2.0 / (9.0 * freedom)
    return _tail(((1.0 - below) * root - (1.0 - above)) / math.sqrt(below * root**2 + above))


def _tail(z: float) -> float:
    """Return the probability that a standard normal variable exceeds z."""
    return 0.5 * math.erfc(z * math.sqrt(0.5))


def truncated_moments(mean: Floats, variance: Floats, lower: Floats, upper: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the moments of Gaussians truncated to intervals, stable far in the tails.

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
    mirrored = a + b > 0  # so that b is nearer to the middle than a, and a is below it
    a, b = np.where(mirrored, -b, a), np.where(mirrored, -a, b)
    width, inside = b - a, b > 0
    with np.errstate(all="ignore"):
        # Of the density at b, or where that is beyond the middle, of the density there.
        at_b = np.where(inside, np.exp(-0.5 * b * b), 1.0)
        at_a = at_b * np.exp(0.5 * width * (a + b))
        below_a, beside_b = 0.5 * _scaled_tail(np.sqrt(0.5) * np.abs([a, b])) * [at_a, at_b]
        mass = np.where(inside, 1.0 - beside_b, beside_b) - below_a
        log_mass = np.log(mass) - np.where(inside, 0.0, 0.5 * b * b)
        density_a, density_b = _PEAK * at_a / mass, _PEAK * at_b / mass
        m = density_a - density_b
        v = 1.0 + np.where(np.isfinite(a), a * density_a, 0.0) - b * density_b - m * m
    # Far out the density is exponential; in a narrow interval it is uniform, an exponential of a small rate.
    far = (b < -300) | (width < 1e-3) | ~(v > 0)
    m, v = np.clip(m, a, b), np.minimum(v, width**2 / 4)
    if far.any():
        start, end, span = a[far], b[far], width[far]
        rate = np.maximum(-0.5 * (np.maximum(start, end - 1.0) + end), 0.0)
        tail_mean, v[far] = _exponential_moments(rate, span)
        m[far] = end - tail_mean
        flat_mass = np.log(np.maximum(span, 1e-300)) - 0.125 * (start + end) ** 2 - _LOG_SQRT_2PI
        log_mass[far] = np.where(np.isfinite(log_mass[far]) & (span >= 1e-3), log_mass[far], flat_mass)
    return log_mass, mean + sd * np.where(mirrored, -m, m), variance * v


def _exponential_moments(rate: Floats, width: Floats) -> tuple[Floats, Floats]:
    """Return mean and variance of an exponential density on [0, width]; it is uniform where rate * width is small."""
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
    """Return the moments of a Gaussian times a mixture of uniform densities.

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
