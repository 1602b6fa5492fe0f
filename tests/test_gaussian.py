"""The normal distribution against SciPy's, which is right to a few units in the last place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special
from scipy.integrate import quad
from scipy.stats import norm

from optshape_graph.gaussian import log_ndtr, logsumexp, mixture_moments, ndtr, truncated_moments

X = np.concatenate([np.linspace(-45, 45, 30_001), np.linspace(-1.5, 1.5, 10_001), [0.0, -0.0, np.sqrt(2), -np.sqrt(2)]])


def test_probabilities() -> None:
    usual = X[X > -37]  # beyond, the numbers are denormal
    np.testing.assert_allclose(ndtr(usual), special.ndtr(usual), rtol=2e-14, atol=0)
    np.testing.assert_allclose(ndtr(X), special.ndtr(X), rtol=0, atol=1e-15)
    assert ndtr(0.0) == 0.5
    assert ndtr([-np.inf, np.inf]).tolist() == [0.0, 1.0]
    assert np.isnan(ndtr(np.nan))


def test_their_logarithms() -> None:
    np.testing.assert_allclose(log_ndtr(X), special.log_ndtr(X), rtol=1e-13, atol=1e-300)
    far = -np.geomspace(1.0, 1e100, 2001)
    np.testing.assert_allclose(log_ndtr(far), special.log_ndtr(far), rtol=1e-13)
    assert log_ndtr([-np.inf, np.inf]).tolist() == [-np.inf, 0.0]
    assert np.isnan(log_ndtr(np.nan))


@given(st.lists(st.floats(-1e300, 700) | st.just(-np.inf), min_size=1, max_size=20))
def test_sums_of_exponentials(values: list[float]) -> None:
    np.testing.assert_allclose(logsumexp(values), special.logsumexp(values), rtol=1e-14, atol=1e-14)
    stack = np.array([values, values[::-1]])
    np.testing.assert_allclose(logsumexp(stack, axis=1), special.logsumexp(stack, axis=1), rtol=1e-14, atol=1e-14)


def test_shapes() -> None:
    for shape in ((), (0,), (2, 3), (2, 0, 4)):
        assert ndtr(np.zeros(shape)).shape == log_ndtr(np.zeros(shape)).shape == shape
    with pytest.raises(ValueError, match="zero-size"):
        logsumexp([])


@given(st.floats(-6, 6), st.floats(0.05, 3), st.floats(-3, 3), st.floats(0.01, 4))
def test_moments_against_quadrature(mean: float, sd: float, lower: float, width: float) -> None:
    upper = lower + width
    log_mass, m, v = (float(x) for x in truncated_moments(*(np.array(x) for x in (mean, sd**2, lower, upper))))
    # Relative to the density's peak in the interval, so that the far tail is integrated as exactly as the middle.
    peak = norm.logpdf(np.clip(mean, lower, upper), mean, sd)

    def moment(k: int) -> float:
        def integrand(x: float) -> float:
            return float((x - m) ** k * np.exp(norm.logpdf(x, mean, sd) - peak))

        near = np.clip(mean, lower, upper)
        points = sorted({*np.clip([near - 3 * sd, near + 3 * sd, near - 0.3 * sd, near + 0.3 * sd], lower, upper)})
        return float(quad(integrand, lower, upper, limit=400, points=points)[0])

    mass = moment(0)
    assert log_mass == pytest.approx(np.log(mass) + peak, abs=2e-5)
    assert moment(1) / mass == pytest.approx(0.0, abs=2e-5 * width)
    assert v == pytest.approx(moment(2) / mass, rel=2e-2, abs=1e-5 * width**2)


def test_far_tails_stay_inside() -> None:
    mean = np.array([-1e3, 1e3, 50.0, -50.0])
    log_mass, m, v = truncated_moments(mean, np.full(4, 1e-2), np.zeros(4), np.ones(4))
    assert ((m >= 0) & (m <= 1)).all()
    assert ((v > 0) & (v <= 1 / 12)).all()
    assert np.isfinite(log_mass).all()


def test_mixture_of_one_is_that_one() -> None:
    arguments = np.array([0.3]), np.array([0.4])
    one = truncated_moments(*arguments, np.array([0.0]), np.array([1.0]))
    twice = mixture_moments(*arguments, np.zeros((2, 1)), np.ones((2, 1)), np.log(np.array([[0.25], [0.75]])))
    np.testing.assert_allclose(np.array(one), np.array(twice), rtol=1e-12)
