"""Reduction of stacked rows: the same quadratic form, upper triangular, however the columns hang together."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph.factors._rows import _by_parts, triangular, triangular_by_parts


@given(
    st.integers(1, 60),
    st.integers(0, 400),
    st.floats(0.0, 0.2),
    st.integers(0, 5),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_parts_make_the_same_form(k: int, m: int, share: float, common: int, prior: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    stack = rng.normal(size=(m, k + 13))
    stack[:, :k] *= (rng.random((m, k)) < share) | np.isin(np.arange(k), rng.choice(k, min(common, k), replace=False))
    if prior:
        stack = np.vstack([np.eye(k, k + 13), stack])
    reduced, expected = _by_parts(stack, k), triangular(stack)
    assert reduced.shape == (k + 13, k + 13)
    np.testing.assert_array_equal(np.tril(reduced, -1)[k:], 0.0)
    np.testing.assert_allclose(
        reduced.T @ reduced, expected.T @ expected, atol=1e-12 * max(1.0, float((stack**2).sum()))
    )


@pytest.mark.parametrize("rings", [30, 128])
def test_rings_with_two_errors_each(rings: int) -> None:
    """Range biases of all rings, then their elevations, each in its ring's rows only."""
    rng, ring = np.random.default_rng(rings), np.repeat(np.arange(rings), 20)
    k, rows = 2 * rings, np.arange(len(ring))
    stack = np.zeros((len(ring), k + 13))
    stack[rows, ring], stack[rows, rings + ring] = rng.normal(size=(2, len(ring)))
    stack[:, k:] = rng.normal(size=(len(ring), 13))
    reduced = _by_parts(stack, k)
    np.testing.assert_allclose(reduced.T @ reduced, stack.T @ stack, atol=1e-10)
    assert np.count_nonzero(reduced[:k, :k]) == 3 * rings, "no ring knows another's errors"


def test_errors_that_all_rings_share_join_no_rings() -> None:
    rng, ring = np.random.default_rng(0), np.repeat(np.arange(30), 20)
    stack = np.zeros((600, 62 + 13))
    stack[np.arange(600), 1 + ring], stack[np.arange(600), 31 + ring] = rng.normal(size=(2, 600))
    stack[:, [0, 61]] = rng.normal(size=(600, 2))
    stack[:, 62:] = rng.normal(size=(600, 13)) * (np.arange(13) % 3 > 0)
    reduced = _by_parts(stack, 62)
    np.testing.assert_allclose(reduced.T @ reduced, stack.T @ stack, atol=1e-10)
    np.testing.assert_array_equal(reduced[62:, :62], 0.0)
    assert np.count_nonzero(reduced[1:61, 1:61]) == 90


def test_large_stacks_are_reduced_by_parts() -> None:
    stack = np.random.default_rng(0).normal(size=(3000, 90)) * (np.arange(90) % 7 > 0)
    np.testing.assert_array_equal(triangular_by_parts(stack, 77), _by_parts(stack, 77))
    np.testing.assert_array_equal(triangular_by_parts(stack[:90], 77), triangular(stack[:90]))
