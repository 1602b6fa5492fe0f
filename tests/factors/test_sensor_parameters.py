import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, H, L, X
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.factors import (
    AugmentedMeasurement,
    SensorParameterFactor,
    azimuth_directions,
    edge_motion_rows,
    edge_rows,
    plane_motion_rows,
    plane_rows,
    range_directions,
)
from tests.factors.support import TARGET, edge_points, numerical, random_pose, retract, scales, seeds
from tests.factors.test_template import jacobian, values_of


def augmented(rng, points, edge, T_target_lidar, n_parameters=2, sigma=0.01):
    A, r = edge_rows(points, TARGET.normals[edge], TARGET.offsets[edge])
    P, s = plane_rows(points)
    outward = np.where(rng.random(len(points)) < 0.5, 1.0, -1.0)
    directions = [range_directions(points), azimuth_directions(points, outward)][:n_parameters]
    motion = [np.vstack([edge_motion_rows(q, TARGET.normals[edge]), plane_motion_rows(q)]) / sigma for q in directions]
    rows = np.vstack([A, P]) / sigma, motion, np.append(r, s) / sigma
    return AugmentedMeasurement.from_rows(*rows, T_target_lidar), directions


@given(seeds, scales, st.integers(0, 2))
def test_exact_for_every_pose_and_parameter(seed, scale, n_parameters):
    rng = np.random.default_rng(seed)
    points, edge = edge_points(rng, random_pose(rng), 40, noise=0.02)
    measurement, directions = augmented(rng, points, edge, np.eye(4), n_parameters)
    assert measurement.stack.shape == (13 + 9 * n_parameters,) * 2
    T, theta = random_pose(rng, scale), rng.normal(size=n_parameters)
    moved = points + sum((value * q for value, q in zip(theta, directions, strict=True)), np.zeros(3))
    A, r = edge_rows(moved, TARGET.normals[edge], TARGET.offsets[edge])
    P, s = plane_rows(moved)
    z = T[:3].T.ravel()
    expected = 0.5 * np.square(np.append(A @ z + r, P @ z + s) / 0.01).sum()
    assert measurement.error(T, theta) == pytest.approx(expected, rel=1e-9)
    assert measurement.fixed(theta).error(T) == pytest.approx(expected, rel=1e-9)
    assert (measurement + measurement).error(T, theta) == pytest.approx(2 * expected, rel=1e-9)


@given(seeds, scales)
def test_jacobians(seed, scale):
    rng = np.random.default_rng(seed)
    T, theta = random_pose(rng, scale), rng.normal(size=2)
    points, edge = edge_points(rng, random_pose(rng), 20, noise=0.02)
    measurement, _ = augmented(rng, points, edge, np.eye(4))
    by_pose, by_theta = measurement.jacobians(T, theta)
    scale_of = np.abs(by_pose).max()
    J = numerical(lambda xi: measurement.residual(retract(T, xi), theta), 6)
    np.testing.assert_allclose(by_pose, J, atol=1e-7 * scale_of)
    J = numerical(lambda d: measurement.residual(T, theta + d), 2)
    np.testing.assert_allclose(by_theta, J, atol=1e-7 * scale_of)


@given(seeds)
def test_factor_between_two_poses(seed):
    rng = np.random.default_rng(seed)
    poses = {"l0": random_pose(rng), "x0": random_pose(rng)}
    points, edge = edge_points(rng, random_pose(rng), 20)
    measurement, _ = augmented(rng, points, edge, np.eye(4))
    values = values_of(**poses)
    values.insert(B(0), 0.3)
    values.insert(B(1), -0.2)
    factor = SensorParameterFactor(measurement, (L(0), X(0)), [B(0), B(1)])
    relative = np.linalg.inv(poses["l0"]) @ poses["x0"]
    assert factor.error(values) == pytest.approx(measurement.error(relative, [0.3, -0.2]), rel=1e-9)
    J, _ = factor.linearize(values).jacobian()
    for key, block in ((L(0), J[:, :6]), (X(0), J[:, 6:12])):
        np.testing.assert_allclose(block, jacobian(factor, values, key), atol=1e-7 * np.abs(J).max())
    np.testing.assert_allclose(J[:, 12:], measurement.jacobians(relative, [0.3, -0.2])[1], atol=1e-8 * np.abs(J).max())


def test_scans_at_different_poses_recover_a_range_bias():
    rng = np.random.default_rng(8)
    sigma, bias = 0.005, 0.04
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(B(0), 0.0)
    graph.push_back(gtsam.PriorFactorDouble(B(0), 0.0, gtsam.noiseModel.Isotropic.Sigma(1, 0.1)))
    for i, depth in enumerate([1.0, 2.0, 3.0]):
        T_lidar_target = np.eye(4)
        T_lidar_target[:3, :3] = gtsam.Rot3.Expmap(rng.normal(size=3) * 0.2).matrix()
        T_lidar_target[:3, 3] = [depth, 0.1, 0.0]
        points, edge = edge_points(rng, T_lidar_target, 400, noise=sigma)
        measurement, _ = augmented(rng, points - bias * range_directions(points), edge, np.eye(4), 1, sigma)
        graph.push_back(SensorParameterFactor(measurement, H(i), [B(0)]))
        values.insert(H(i), gtsam.Pose3(retract(np.linalg.inv(T_lidar_target), 0.02 * rng.normal(size=6))))
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    deviation = np.sqrt(gtsam.Marginals(graph, solution).marginalCovariance(B(0))[0, 0])
    assert deviation < 0.015
    assert solution.atDouble(B(0)) == pytest.approx(bias, abs=4 * deviation)


def test_azimuth_directions_turn_points_about_the_spin_axis():
    points = np.array([[3.0, 1.0, 0.5], [-2.0, 4.0, -1.0]])
    alpha, outward = 1e-6, np.array([1.0, -1.0])
    moved = points + alpha * azimuth_directions(points, outward)
    turn = np.arctan2(moved[:, 1], moved[:, 0]) - np.arctan2(points[:, 1], points[:, 0])
    np.testing.assert_allclose(turn, alpha * outward, rtol=1e-9)
    np.testing.assert_allclose(moved[:, 2], points[:, 2])


def test_bad_input():
    rng = np.random.default_rng(0)
    points, edge = edge_points(rng, np.eye(4), 5)
    one, two = (augmented(rng, points + 1.0, edge, np.eye(4), k)[0] for k in (1, 2))
    with pytest.raises(InputError, match="1 and 2 parameters"):
        one + two
    with pytest.raises(InputError, match="2 keys for 1"):
        SensorParameterFactor(one, H(0), [B(0), B(1)])
    with pytest.raises(InputError, match="theta: expected 1"):
        one.residual(np.eye(4), [1.0, 2.0])
    with pytest.raises(InputError, match="14 columns"):
        AugmentedMeasurement(np.eye(14), 1, np.eye(4))
