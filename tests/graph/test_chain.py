"""Chains of variables that are given as arrays."""

import gtsam
import numpy as np

from optshape_graph.graph import Chains, Inverse, State
from optshape_graph.se3 import exp


def test_between_is_the_chain_of_an_inverse_and_a_variable() -> None:
    """The same poses, keys and derivatives as of the chains written out; to the bit, being the same products."""
    rng = np.random.default_rng(3)
    values = gtsam.Values()
    for key in range(6):
        values.insert(key, gtsam.Pose3(exp(rng.normal(size=6))))
    first, second, R = np.array([4, 0, 4, 5]), np.array([1, 2, 3, 1]), rng.normal(size=(4, 6, 6))
    together = Chains.between(first, second)
    written = Chains([[Inverse(int(a)), int(b)] for a, b in zip(first, second, strict=True)])
    state = State.of(values)
    assert len(together) == len(written) == 4
    assert together.keys == written.keys == [[4, 1], [0, 2], [4, 3], [5, 1]]
    np.testing.assert_array_equal(together.at(state), written.at(state))
    np.testing.assert_array_equal(together.derivatives(R, state), written.derivatives(R, state))
    assert len(Chains.between(first[:0], second[:0])) == 0
