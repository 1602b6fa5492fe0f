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
    """To a tenth of what a ring's own variance is worth in the mean of all."""
    rng = np.random.default_rng(seed)
    elevation = np.sort(rng.uniform(-0.3, 0.3, 24))
    elevation -= elevation.mean()
    sd = own * rng.uniform(0.8, 1.2, 24)
    covariance = np.diag(sd**2) + common**2 + trend**2 * np.outer(elevation, elevation)
    found, c, t = Deviation(np.zeros(24), covariance, covariance, np.ones(24, bool), elevation).parts
    left = 0.1 * own**2 / 24
    assert c**2 == pytest.approx(common**2, abs=left)
    assert t**2 == pytest.approx(trend**2, abs=left / np.mean(elevation**2))
    assert found**2 == pytest.approx(sd**2, abs=own**2 / 24)


def test_rings_that_were_not_seen_keep_what_the_file_says() -> None:
    elevation, seen = np.linspace(-0.2, 0.2, 9), np.arange(9) > 1
    covariance = 1e-6 * np.diag(np.where(seen, 1.0, 100.0))
    own, common, trend = Deviation(np.zeros(9), covariance, covariance, seen, elevation).parts
    assert own == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.02)
    assert common < 1e-4
    assert trend < 1e-4 / 0.1
