"""Moments of truncated Gaussians against numerical integration."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from optshape_graph.pose.propagation import mixture_moments, truncated_moments


@given(st.floats(-6, 6), st.floats(0.05, 3), st.floats(-3, 3), st.floats(0.01, 4))
def test_against_quadrature(mean: float, sd: float, lower: float, width: float) -> None:
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
