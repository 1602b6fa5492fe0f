"""Metrics: the paper's formulas, symmetry, and errors against covariances."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from optshape_graph.evaluation.metrics import (
    normalised_error,
    pose_error,
    quantisation_error,
    vertex_jacobian,
)
from optshape_graph.io import load_target
from optshape_graph.simulation import pose_from_rpy

TARGET = load_target("paper")
small = st.tuples(*[st.floats(-0.3, 0.3)] * 6).map(np.array)
TRUTH = pose_from_rpy([8.0, 1.0, -0.5], [0.2, 0.3, -0.4])


@settings(max_examples=50, deadline=None)
@given(xi=small)
def test_errors_are_the_formulas(xi):
    T = TRUTH @ gtsam.Pose3.Expmap(xi).matrix()
    error = pose_error(TARGET, T, TRUTH)
    vertices, truth = (TARGET.vertices @ M[:3, :3].T + M[:3, 3] for M in (T, TRUTH))
    assert error.rmse == pytest.approx(np.sqrt(np.mean(np.sum((vertices - truth) ** 2, axis=1))))
    assert error.e_t == pytest.approx(np.linalg.norm(T[:3, 3] - TRUTH[:3, 3]))
    cosine = (np.trace(TRUTH[:3, :3] @ T[:3, :3].T) - 1) / 2
    assert error.e_r == pytest.approx(np.arccos(np.clip(cosine, -1, 1)), abs=1e-6)  # arccos near 1
    assert error.e_r == pytest.approx(np.linalg.norm(xi[:3]), abs=1e-9)
    assert error.rmse_pct == pytest.approx(100 * error.rmse / np.linalg.norm(truth.mean(axis=0)))
    assert error.e_t_pct == pytest.approx(100 * error.e_t / np.linalg.norm(TRUTH[:3, 3]))


def test_quantisation_error_is_that_of_the_published_table():
    assert quantisation_error(np.radians(0.4), 2.00461) == pytest.approx(0.0139948, rel=1e-4)


@pytest.mark.parametrize("name", ["square", "triangle", "diamond"])
def test_errors_are_modulo_the_target_symmetry(name):
    target = load_target(name)
    T = TRUTH @ gtsam.Pose3.Expmap(np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.01])).matrix()
    expected = pose_error(target, T, TRUTH)
    assert np.degrees(expected.e_r) < 3
    covariance = np.diag([1e-3, 2e-3, 3e-3, 1e-4, 2e-4, 3e-4])
    nees = normalised_error(target, T, covariance, TRUTH).nees
    for rotation in target.symmetry_transforms[:, :3, :3]:
        S = np.eye(4)
        S[:3, :3] = rotation
        turned = pose_error(target, T @ S, TRUTH)
        assert turned.rmse == pytest.approx(expected.rmse)
        assert turned.e_r == pytest.approx(expected.e_r)
        # the same covariance, of T @ S
        adjoint = gtsam.Pose3(S).inverse().AdjointMap()
        moved = normalised_error(target, T @ S, adjoint @ covariance @ adjoint.T, TRUTH)
        assert moved.nees == pytest.approx(nees)


def test_an_asymmetric_target_turned_by_half_a_turn_is_wrong():
    S = np.diag([1.0, -1.0, -1.0, 1.0])
    assert np.degrees(pose_error(TARGET, TRUTH @ S, TRUTH).e_r) == pytest.approx(180)


def test_normalised_errors_drawn_from_the_covariance_are_chi_square():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * np.repeat([0.005, 0.01], 3)[:, None]
    covariance = A @ A.T + np.diag(np.repeat([1e-5, 1e-6], 3))
    nees, vertex = [], []
    for _ in range(1000):
        xi = rng.multivariate_normal(np.zeros(6), covariance)
        T = TRUTH @ gtsam.Pose3.Expmap(-xi).matrix()
        error = normalised_error(TARGET, T, covariance, TRUTH)
        np.testing.assert_allclose(error.xi, xi, atol=1e-9)
        nees.append(error.nees)
        vertex.append(error.vertex_nees[0])
    # Kolmogorov-Smirnov at a level of 0.1 %; vertices are linearised, errors are a few degrees
    assert kstest(nees, "chi2", (6,)).pvalue > 1e-3
    assert kstest(vertex, "chi2", (3,)).pvalue > 1e-3


@settings(max_examples=20, deadline=None)
@given(xi=small)
def test_vertex_jacobian_is_the_derivative(xi):
    h = 1e-6

    def vertices(step):
        T = gtsam.Pose3.Expmap(step * xi).matrix()
        return TARGET.vertices @ T[:3, :3].T + T[:3, 3]

    numerical = (vertices(h) - vertices(-h)) / (2 * h)
    np.testing.assert_allclose(vertex_jacobian(TARGET) @ xi, numerical, atol=1e-8)
