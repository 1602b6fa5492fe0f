import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from optshape_graph.graph import add_rows, linear
from optshape_graph.graph.linear import LinearSystem
from tests.factors.support import random_pose


def of(graph, values):
    return LinearSystem.of(graph.linearize(values), values)


def chain(rng, n, prior=True):
    """Return a chain of poses and its values, with a prior at the start if wanted."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 0.01, 0.02, 0.05, 0.05, 0.1]))
    poses = [gtsam.Pose3(random_pose(rng)) for _ in range(n)]
    for i, pose in enumerate(poses):
        values.insert(X(i), pose)
        if i:
            graph.push_back(gtsam.BetweenFactorPose3(X(i - 1), X(i), poses[i - 1].between(pose), noise))
    if prior:
        graph.push_back(gtsam.PriorFactorPose3(X(0), poses[0], noise))
    return graph, values


@pytest.mark.parametrize("n", [6, 150])  # below and above the limit of the dense eigenvalues
def test_covariances_are_gtsams(n):
    graph, values = chain(np.random.default_rng(0), n)
    system = of(graph, values)
    assert (system.A.shape[1] > linear.DENSE_LIMIT) == (n > 100)
    marginals = gtsam.Marginals(graph, values)
    keys = [X(3), X(1)]
    joint = marginals.jointMarginalCovariance(keys)
    expected = np.block([[joint.at(i, j) for j in keys] for i in keys])
    np.testing.assert_allclose(system.covariance(keys), expected, rtol=1e-5, atol=1e-8)
    assert system.unobservable.shape[1] == 0
    assert system.decrement < 1e-12


@pytest.mark.parametrize("n", [6, 150])
def test_free_gauge_has_six_directions(n):
    graph, values = chain(np.random.default_rng(1), n, prior=False)
    system = of(graph, values)
    null = system.unobservable
    assert null.shape[1] == 6
    assert np.abs(system.A @ null).max() < 1e-5 * np.abs(system.A).max() * np.abs(null).max()


def test_a_variable_that_no_factor_touches_is_not_observable():
    graph, values = chain(np.random.default_rng(2), 3)
    values.insert(X(9), gtsam.Pose3())
    system = of(graph, values)
    null = system.unobservable
    assert null.shape[1] == 6
    assert np.abs(null[system.columns[X(9)]]).max() > 0.9
    assert np.abs(null[: system.columns[X(9)].start]).max() < 1e-9


def test_decrement_is_what_a_step_gains():
    rng = np.random.default_rng(3)
    graph, values = chain(rng, 4)
    moved = values.retract(values.zeroVectors())
    moved.update(X(2), values.atPose3(X(2)).retract(1e-3 * rng.normal(size=6)))
    system = of(graph, moved)
    step = graph.linearize(moved).optimize()
    gained = graph.error(moved) - graph.error(moved.retract(step))
    assert system.decrement == pytest.approx(gained, rel=0.02)


@pytest.mark.parametrize("size", [1.0, 1e7])
def test_few_rows_on_many_variables_are_rows_again(size):
    """Two rows on four variables of six each: in GTSAM a factor in information form, singular, and huge."""
    rng = np.random.default_rng(0)
    blocks, b = [size * rng.normal(size=(2, 6)) for _ in range(4)], size * rng.normal(size=2)
    linear, values = gtsam.GaussianFactorGraph(), gtsam.Values()
    for key in range(4):
        values.insert(key, np.zeros(6))
    add_rows(linear, [3, 0, 2, 1], blocks, b)
    add_rows(linear, [2], [np.eye(6)], np.zeros(6))
    system = LinearSystem.of(linear, values)
    A = np.zeros((8, 24))
    for key, block in zip([3, 0, 2, 1], blocks, strict=True):
        A[:2, 6 * key : 6 * key + 6] = block
    A[2:, 12:18] = np.eye(6)
    assert np.allclose(system.information.toarray(), A.T @ A, rtol=1e-9, atol=1e-9 * size**2)
    assert np.allclose(system.A.T @ system.b, A.T @ np.append(b, np.zeros(6)), rtol=1e-7, atol=1e-7 * size**2)
