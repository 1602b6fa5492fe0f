"""The normal distribution in NumPy: logarithms of its tails, to rounding, and its moments within intervals.

SciPy has the same, but importing `scipy.special` takes longer than estimating a pose, and most runs estimate few.

With t = |x| / sqrt(2) the smaller tail is erfc(t) / 2. Below t = 1, erfc(t) is 1 - erf(t), and erf(t) is t times a
ratio of polynomials in t^2; from t = 1 on, erfc(t) is exp(-t^2) times a ratio in t. The ratios are those of Cephes
(Moshier, Methods and Programs for Mathematical Functions, 1989).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats

_ERF = (
    [9.60497373987051638749, 9.00260197203842689217e1, 2.23200534594684319226e3, 7.00332514112805075473e3,
     5.55923013010394962768e4],
    [1.0, 3.35617141647503099647e1, 5.21357949780152679795e2, 4.59432382970980127987e3, 2.26290000613890934246e4,
     4.92673942608635921086e4],
)  # fmt: skip
_NEAR = (
    [2.46196981473530512524e-10, 5.64189564831068821977e-1, 7.46321056442269912687, 4.86371970985681366614e1,
     1.96520832956077098242e2, 5.26445194995477358631e2, 9.34528527171957607540e2, 1.02755188689515710272e3,
     5.57535335369399327526e2],
    [1.0, 1.32281951154744992508e1, 8.67072140885989742329e1, 3.54937778887819891062e2, 9.75708501743205489753e2,
     1.82390916687909736289e3, 2.24633760818710981792e3, 1.65666309194161350182e3, 5.57535340817727675546e2],
)  # fmt: skip
_FAR = (
    [5.64189583547755073984e-1, 1.27536670759978104416, 5.01905042251180477414, 6.16021097993053585195,
     7.40974269950448939160, 2.97886665372100240670],
    [1.0, 2.26052863220117276590, 9.39603524938001434673, 1.20489539808096656605e1, 1.70814450747565897222e1,
     9.60896809063285878198, 3.36907645100081516050],
)  # fmt: skip

_FAR_FROM = 8.0
"""From this t on, the ratio for far tails is used."""

_LOG_SQRT_2PI = 0.5 * np.log(2 * np.pi)


def ndtr(x: ArrayLike) -> Floats:
    """Return the probability (...) that a standard normal variable is below x (...), as a number."""
    x = np.asarray(x, float)
    t = np.abs(x) * np.sqrt(0.5)
    with np.errstate(under="ignore"):
        tail = 0.5 * np.where(t < 1.0, 1.0 - _erf(np.minimum(t, 1.0)), np.exp(-t * t) * _scaled_tail(t))
    return np.asarray(np.where(x < 0.0, tail, 1.0 - tail))


def log_ndtr(x: ArrayLike) -> Floats:
    """Return the logarithm (...) of `ndtr`, a number that does not underflow."""
    x = np.asarray(x, float)
    t = np.abs(x) * np.sqrt(0.5)
    with np.errstate(under="ignore"):
        scaled = _scaled_tail(t)
        tail = 0.5 * np.where(t < 1.0, 1.0 - _erf(np.minimum(t, 1.0)), np.exp(-t * t) * scaled)
        below = np.where(t < 1.0, np.log(np.maximum(tail, 0.01)), np.log(0.5 * scaled) - t * t)
    return np.asarray(np.where(x < 0.0, below, np.log1p(-tail)))


def logsumexp(values: ArrayLike, axis: int | None = None) -> Floats:
    """Return the logarithm of the sum of exponentials of values (...), numbers, along an axis or of all of them."""
    values = np.asarray(values, float)
    top = np.max(values, axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore", under="ignore"):
        total = np.log(np.exp(values - top).sum(axis=axis, keepdims=True)) + top
    return np.asarray(np.squeeze(total, axis=axis))


def _erf(t: Floats) -> Floats:
    """Return erf(t) for t from 0 to 1."""
    return np.asarray(t * _ratio(_ERF, t * t))


def _scaled_tail(t: Floats) -> Floats:
    """Return exp(t^2) erfc(t) for t >= 1; for smaller t some finite number."""
    tail, far = _ratio(_NEAR, np.clip(t, 1.0, _FAR_FROM)), t > _FAR_FROM
    if far.any():
        reached = np.minimum(t[far], 1e30)
        tail[far] = _ratio(_FAR, 1.0 / reached, flipped=True) / reached
    return tail


def _ratio(of: tuple[list[float], list[float]], x: Floats, flipped: bool = False) -> Floats:
    """Return a ratio of polynomials in x; flipped: x times the ratio in 1 / x, for x whose powers would overflow."""
    top, bottom = (part[::-1] if flipped else part for part in of)
    return np.asarray(_polynomial(top, x) / _polynomial(bottom, x))


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
    right = a > 0  # mirrored, so that the interval is never in the upper tail
    a, b = np.where(right, -b, a), np.where(right, -a, b)
    log_a, log_b = log_ndtr(np.stack([a, b]))
    width = b - a
    with np.errstate(all="ignore"):
        log_mass = log_b + np.log1p(-np.exp(log_a - log_b))
        density_a = np.exp(-0.5 * a * a - _LOG_SQRT_2PI - log_mass)
        density_b = np.exp(-0.5 * b * b - _LOG_SQRT_2PI - log_mass)
        m = density_a - density_b
        v = 1.0 + np.where(np.isfinite(a), a * density_a, 0.0) - b * density_b - m * m
    # Far out the density is exponential; in a narrow interval it is uniform, an exponential of a small rate.
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
