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
    """To a tenth, or to a tenth of what a ring's own variance is worth in the mean of all.

    Mean and trend are told apart as if nothing but they and the rings' own errors were there, each by itself.
    """
    elevation = np.sort(np.random.default_rng(seed).uniform(-0.3, 0.3, 24))
    elevation -= elevation.mean()
    covariance = own**2 * np.eye(24) + common**2 + trend**2 * np.outer(elevation, elevation)
    found, c, t = Deviation(np.zeros(24), covariance, covariance, np.ones(24, bool), elevation).parts
    left = 0.1 * own**2 / 24
    assert c**2 == pytest.approx(common**2, rel=0.1, abs=left)
    assert t**2 == pytest.approx(trend**2, rel=0.1, abs=left / np.mean(elevation**2))
    assert found**2 + c**2 + (t * elevation) ** 2 == pytest.approx(np.diag(covariance), rel=0.1)


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
