import gtsam
import numpy as np
from hypothesis import given

from optshape_graph.factors import inverse_covariance
from optshape_graph.factors.se3 import adjoint, inverse, vec, vec_derivative
from tests.factors.support import log, numerical, random_pose, retract, scales, seeds


@given(seeds, scales)
def test_matches_gtsam(seed, scale):
    T = random_pose(np.random.default_rng(seed), scale)
    pose = gtsam.Pose3(T)
    np.testing.assert_allclose(inverse(T), pose.inverse().matrix(), atol=1e-12)
    np.testing.assert_allclose(adjoint(T), pose.AdjointMap(), atol=1e-12)
    np.testing.assert_allclose(vec(T)[:9].reshape(3, 3).T, T[:3, :3])
    np.testing.assert_allclose(vec(T)[9:], T[:3, 3])


@given(seeds, scales)
def test_derivative_of_vec(seed, scale):
    T = random_pose(np.random.default_rng(seed), scale)
    # Central differences with step 1e-5: truncation 1e-10, rounding 1e-10 at entries of 5 m.
    np.testing.assert_allclose(vec_derivative(T), numerical(lambda xi: vec(retract(T, xi)), 6), atol=1e-8)


def test_batches_are_stacks_of_single_ones():
    rng = np.random.default_rng(0)
    T = np.stack([random_pose(rng) for _ in range(6)]).reshape(2, 3, 4, 4)
    for function in (inverse, vec, vec_derivative, adjoint):
        batch = function(T)
        for i in np.ndindex(2, 3):
            np.testing.assert_allclose(batch[i], function(T[i]))


def test_inverse_covariance_against_scatter():
    rng = np.random.default_rng(1)
    T = random_pose(rng)
    factor = rng.normal(size=(6, 6)) * 1e-3
    covariance = factor @ factor.T
    samples = np.stack([log(T @ inverse(retract(T, factor @ rng.normal(size=6)))) for _ in range(4000)])
    expected = inverse_covariance(T, covariance)
    # A sample covariance of 4000 has entries within 5 / sqrt(4000) = 8 % of the axes' product, at five sigma.
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(np.cov(samples.T) - expected) / scale).max() < 0.12
    np.testing.assert_allclose(inverse_covariance(inverse(T), expected), covariance, atol=1e-12 * scale.max())
