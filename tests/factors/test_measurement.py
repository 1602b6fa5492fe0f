import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.factors import TemplateMeasurement, edge_rows, plane_rows
from tests.factors.support import TARGET, edge_points, measure, numerical, random_pose, retract, scales, seeds


def residuals(points, edge, T):
    moved = points @ T[:3, :3].T + T[:3, 3]
    return np.einsum("ni,ni->n", TARGET.normals[edge], moved[:, 1:]) - TARGET.offsets[edge], moved[:, 0]


@given(seeds, scales, st.integers(0, 60))
def test_error_is_that_of_the_points_at_any_pose(seed, scale, n):
    rng = np.random.default_rng(seed)
    points, edge = edge_points(rng, random_pose(rng), n, noise=0.02)
    A, r = edge_rows(points, TARGET.normals[edge], TARGET.offsets[edge])
    P, s = plane_rows(points)
    weight = rng.uniform(10, 200, 2 * n)
    stacked = np.vstack([A, P]) * weight[:, None], np.append(r, s) * weight
    measurement = TemplateMeasurement.from_rows(*stacked, np.eye(4))
    T = random_pose(rng, scale)
    expected = 0.5 * np.square(np.concatenate(residuals(points, edge, T)) * weight).sum()
    z1 = np.append(T[:3].T.ravel(), 1.0)
    # QR keeps the sum of squares to rounding: 1e-16 of the largest term times the number of operations.
    assert measurement.error(T) == pytest.approx(expected, rel=1e-10, abs=1e-8)
    assert 0.5 * z1 @ measurement.quadratic() @ z1 == pytest.approx(expected, rel=1e-9, abs=1e-6)
    assert measurement.n_rows == 2 * n


@given(seeds, st.integers(0, 60))
def test_edge_points_of_one_accuracy(seed, n):
    rng = np.random.default_rng(seed)
    points, edge = edge_points(rng, random_pose(rng), n, noise=0.02)
    normals, offsets, T = TARGET.normals[edge], TARGET.offsets[edge], random_pose(rng)
    A, r = edge_rows(points, normals, offsets)
    P, s = plane_rows(points)
    expected = TemplateMeasurement.from_rows(np.vstack([A / 0.01, P / 0.02]), np.append(r / 0.01, s / 0.02), T)
    found = TemplateMeasurement.from_edge_points(points, normals, offsets, 0.01, 0.02, T)
    np.testing.assert_allclose(found.quadratic(), expected.quadratic(), rtol=1e-9, atol=1e-6)
    assert found.n_rows == expected.n_rows


@given(seeds, scales)
def test_gradient_and_information(seed, scale):
    rng = np.random.default_rng(seed)
    T = random_pose(rng, scale)
    measurement = measure(rng, T)
    J = numerical(lambda xi: measurement.residual(retract(T, xi)), 6)
    np.testing.assert_allclose(measurement.jacobian(T), J, atol=1e-8 * np.abs(J).max())
    np.testing.assert_allclose(measurement.information(), J.T @ J, atol=1e-8 * np.abs(J).max() ** 2)
    np.testing.assert_allclose(measurement.gradient(T), J.T @ measurement.residual(T), rtol=1e-5, atol=1e-3)


@given(seeds)
def test_adding_is_stacking(seed):
    rng = np.random.default_rng(seed)
    T = random_pose(rng)
    one, two = measure(rng, T, 7), measure(rng, T, 30)
    H = random_pose(rng)
    assert (one + two).error(H) == pytest.approx(one.error(H) + two.error(H), rel=1e-12)
    assert (one + two).n_rows == one.n_rows + two.n_rows
    np.testing.assert_array_equal((one + two).T_target_lidar, one.T_target_lidar)


@given(seeds)
def test_substitution_is_exact(seed):
    rng = np.random.default_rng(seed)
    measurement = measure(rng, random_pose(rng))
    left, right, T = random_pose(rng), random_pose(rng), random_pose(rng)
    substituted = measurement.substituted(left, right)
    assert substituted.error(T) == pytest.approx(measurement.error(left @ T @ right), rel=1e-10)
    np.testing.assert_allclose(left @ substituted.T_target_lidar @ right, measurement.T_target_lidar, atol=1e-10)


@given(seeds)
def test_order_of_points_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    points, edge = edge_points(rng, random_pose(rng), 25, noise=0.01)
    A, r = edge_rows(points, TARGET.normals[edge], TARGET.offsets[edge])
    order = rng.permutation(25)
    one, two = (TemplateMeasurement.from_rows(A[i], r[i], np.eye(4)) for i in (np.arange(25), order))
    np.testing.assert_allclose(one.quadratic(), two.quadratic(), atol=1e-10)


def test_pickles_and_cannot_be_changed():
    rng = np.random.default_rng(0)
    measurement = measure(rng, random_pose(rng))
    copy = pickle.loads(pickle.dumps(measurement))
    np.testing.assert_array_equal(copy.stack, measurement.stack)
    assert (copy.c, copy.n_rows) == (measurement.c, measurement.n_rows)
    with pytest.raises(ValueError, match="read-only"):
        measurement.L[0, 0] = 1.0
    moved = measurement.at(np.eye(4))
    np.testing.assert_array_equal(moved.T_target_lidar, np.eye(4))
    np.testing.assert_array_equal(moved.L, measurement.L)
    assert np.triu(measurement.L) == pytest.approx(measurement.L)


def test_no_rows_measure_nothing():
    measurement = TemplateMeasurement.from_rows(np.zeros((0, 12)), np.zeros(0), np.eye(4))
    assert measurement.error(np.eye(4)) == 0.0
    assert measurement.n_rows == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: edge_rows(np.zeros((3, 2)), np.zeros((3, 2)), np.zeros(3)),
            r"points: expected N x 3.*\(3, 2\)",
        ),
        (lambda: edge_rows(np.zeros((3, 3)), np.zeros((2, 2)), np.zeros(3)), "normals: expected 3 x 2"),
        (lambda: edge_rows(np.zeros((3, 3)), np.zeros((3, 2)), np.zeros(2)), "offsets: expected 3"),
        (lambda: plane_rows([[np.nan, 0, 0]]), "points: 1 of 3 values are not finite"),
        (lambda: TemplateMeasurement.from_rows(np.zeros((4, 11)), np.zeros(4), np.eye(4)), "rows: expected N x 12"),
        (lambda: TemplateMeasurement.from_rows(np.zeros((4, 12)), np.zeros(3), np.eye(4)), "constants: expected 4"),
        (lambda: TemplateMeasurement.from_rows(np.zeros((4, 12)), np.zeros(4), np.eye(3)), "T_target_lidar: exp"),
        (lambda: TemplateMeasurement(np.eye(12), np.zeros(12), np.nan, 1, np.eye(4)), "c is nan"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(InputError, match=message):
        call()
