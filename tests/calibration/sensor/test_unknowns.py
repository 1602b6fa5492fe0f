"""What is left of rings' errors, as a file states it: each ring's own, what all share, and a trend."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph.calibration.sensor.unknowns import Deviation

SD = st.floats(0.0, 0.02)


@given(common=SD, trend=SD, own=st.floats(1e-3, 0.02), seed=st.integers(0, 1000))
def test_parts_are_those_of_which_a_covariance_is_made(common: float, trend: float, own: float, seed: int) -> None:
    """To a tenth of the variance of what rings show of it: its own, and what the rings' own errors add to their fit.

    Mean and trend are told apart as if nothing but they and the rings' own errors were there, each by itself. A ring
    whose elevation is far from the others' has a variance, given theirs, above its own: the sum may be more by that.
    """
    elevation = np.sort(np.random.default_rng(seed).uniform(-0.3, 0.3, 24))
    elevation -= elevation.mean()
    covariance = own**2 * np.eye(24) + common**2 + trend**2 * np.outer(elevation, elevation)
    found, c, t = Deviation(np.zeros(24), covariance, covariance, np.ones(24, bool), elevation).parts
    added = own**2 / 24
    assert abs(c**2 - common**2) <= 0.1 * (common**2 + added)
    assert abs(t**2 - trend**2) <= 0.1 * (trend**2 + added / np.mean(elevation**2))
    total, variance = found**2 + c**2 + (t * elevation) ** 2, np.diag(covariance)
    given_others = 1.0 / np.diag(np.linalg.inv(covariance))
    assert (total >= 0.9 * variance).all()
    assert (total <= 1.1 * variance + given_others - own**2).all()


def test_a_ring_that_is_hardly_seen_tells_no_trend() -> None:
    """The trend of the others is found to a tenth, and all variances are kept."""
    elevation = np.append(np.linspace(-0.1, 0.1, 23), 0.3)
    elevation -= elevation.mean()
    own = np.append(np.full(23, 1e-4), 1e-2)
    covariance = np.diag(own**2) + 0.002**2 * np.outer(elevation, elevation)
    found, common, trend = Deviation(np.zeros(24), covariance, covariance, np.ones(24, bool), elevation).parts
    assert trend == pytest.approx(0.002, rel=0.1)
    total = found**2 + common**2 + (trend * elevation) ** 2
    assert total == pytest.approx(np.diag(covariance), rel=0.05)


def test_rings_that_were_not_seen_keep_what_the_file_says() -> None:
    elevation, seen = np.linspace(-0.2, 0.2, 9), np.arange(9) > 1
    covariance = 1e-6 * np.diag(np.where(seen, 1.0, 100.0))
    own, common, trend = Deviation(np.zeros(9), covariance, covariance, seen, elevation).parts
    assert own == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.02)
    assert common < 1e-4
    assert trend < 1e-4 / 0.1
