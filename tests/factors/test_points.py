import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import H
from hypothesis import given

from optshape_graph.factors import PointToEdgeFactor, PointToPlaneFactor
from tests.factors.support import TARGET, edge_points, log, measure, random_pose, retract, scales, seeds
from tests.factors.test_template import jacobian, values_of


def point_graph(points, edge, sigma, loss=None):
    graph = gtsam.NonlinearFactorGraph()
    for p, k in zip(points, edge, strict=True):
        graph.push_back(PointToEdgeFactor(p, TARGET.normals[k], TARGET.offsets[k], H(0), sigma, sigma, loss))
    return graph


@given(seeds, scales)
def test_sum_over_points_is_the_measurement(seed, scale):
    rng = np.random.default_rng(seed)
    T = random_pose(rng, scale)
    state = rng.bit_generator.state
    measurement = measure(rng, T, 30)
    rng.bit_generator.state = state
    points, edge = edge_points(rng, np.linalg.inv(T), 30, noise=0.01)
    graph, values = point_graph(points, edge, 0.01), values_of(h0=retract(T, 0.1 * rng.normal(size=6)))
    # The 1e-4 along the edge adds 30 x 5e-9 x (distance to the foot)^2.
    at = values.atPose3(H(0)).matrix()
    assert graph.error(values) == pytest.approx(measurement.error(at), rel=1e-9, abs=1e-6)
    information = graph.linearize(values).hessian()[0]
    np.testing.assert_allclose(information, measurement.information(at), atol=1e-8 * np.abs(information).max())
    J, _ = graph.at(0).linearize(values).jacobian()
    np.testing.assert_allclose(J, jacobian(graph.at(0), values, H(0)), atol=1e-6 * np.abs(J).max())


def test_point_of_the_plane():
    rng = np.random.default_rng(1)
    T, p = random_pose(rng), rng.normal(size=3)
    off = (T[:3, :3] @ p + T[:3, 3])[0]
    values = values_of(h0=T)
    assert PointToPlaneFactor(p, H(0), 0.02).error(values) == pytest.approx(0.5 * (off / 0.02) ** 2, rel=1e-4)
    edge_only = PointToEdgeFactor(p, TARGET.normals[1], TARGET.offsets[1], H(0), 0.02)
    across = TARGET.normals[1] @ (T[:3, :3] @ p + T[:3, 3])[1:] - TARGET.offsets[1]
    assert edge_only.error(values) == pytest.approx(0.5 * (across / 0.02) ** 2, rel=1e-4)


def test_robust_losses_and_gnc_reject_outliers():
    rng = np.random.default_rng(2)
    T = random_pose(rng)
    points, edge = edge_points(rng, np.linalg.inv(T), 60, noise=0.005)
    points[::6] += 0.5 * rng.normal(size=(10, 3))
    start = values_of(h0=retract(T, 0.02 * rng.normal(size=6)))

    def error(values):
        return np.linalg.norm(log(T @ np.linalg.inv(values.atPose3(H(0)).matrix())))  # at the target

    def solve(loss):
        return gtsam.LevenbergMarquardtOptimizer(point_graph(points, edge, 0.005, loss), start).optimize()

    least_squares = error(solve(None))
    robust = error(solve(gtsam.noiseModel.mEstimator.Cauchy.Create(1.0)))
    gnc = gtsam.GncLMOptimizer(point_graph(points, edge, 0.005), start, gtsam.GncLMParams())
    # 50 clean points of 5 mm fix the pose to a few millimetres; the outliers pull least squares by centimetres.
    assert least_squares > 0.05
    assert robust < 0.02
    assert error(gnc.optimize()) < 0.02
    weights = gnc.getWeights()
    assert weights[1::6].mean() > 0.9
    assert weights[::6].mean() < 0.2
