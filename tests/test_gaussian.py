"""The normal distribution against SciPy's, which is right to a few units in the last place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special

from optshape_graph.gaussian import log_ndtr, logsumexp, ndtr

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
