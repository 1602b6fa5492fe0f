import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import E, H, L, X
from hypothesis import given

from optshape_graph import EstimationError
from optshape_graph.factors import (
    CheckedFactor,
    PointToEdgeFactor,
    PointToPlaneFactor,
    TemplateCallbackFactor,
    TemplateFactor,
)
from tests.factors.support import (
    TARGET,
    edge_points,
    log,
    measure,
    minimise,
    numerical,
    random_pose,
    retract,
    scales,
    seeds,
)


def values_of(**poses):
    values = gtsam.Values()
    for key, T in poses.items():
        values.insert(gtsam.symbol(key[0], int(key[1:])), gtsam.Pose3(T))
    return values


def jacobian(factor, values, key):
    """Return the numerical derivative of the factor's whitened residual by the pose at key."""

    def at(xi):
        moved = gtsam.Values(values)
        moved.update(key, gtsam.Pose3(retract(values.atPose3(key).matrix(), xi)))
        return factor.whitenedError(moved)

    return numerical(at, 6)


@given(seeds, scales)
def test_compiled_factor_is_exact(seed, scale):
    rng = np.random.default_rng(seed)
    T = random_pose(rng, scale)
    measurement = measure(rng, random_pose(rng))
    factor, values = TemplateFactor(measurement, H(0)), values_of(h0=T)
    assert factor.error(values) == pytest.approx(measurement.error(T), rel=1e-11)
    information = factor.linearize(values).information()
    np.testing.assert_allclose(information, measurement.information(T), atol=1e-9 * np.abs(information).max())
    reference = TemplateCallbackFactor(measurement, H(0))
    assert reference.error(values) == pytest.approx(measurement.error(T), rel=1e-11)
    np.testing.assert_allclose(
        reference.linearize(values).augmentedInformation(),
        factor.linearize(values).augmentedInformation(),
        rtol=1e-8,
        atol=1e-9 * np.abs(information).max(),
    )


@given(seeds, scales)
def test_factor_on_an_extrinsic_between_known_transforms(seed, scale):
    rng = np.random.default_rng(seed)
    A, B, T = random_pose(rng), random_pose(rng), random_pose(rng, scale)
    measurement = measure(rng, A @ T @ B)
    factor, values = TemplateFactor(measurement, E(0), A, B), values_of(e0=T)
    assert factor.error(values) == pytest.approx(measurement.error(A @ T @ B), rel=1e-9)
    J, _ = factor.linearize(values).jacobian()
    np.testing.assert_allclose(J, jacobian(factor, values, E(0)), atol=1e-7 * np.abs(J).max())
    right_only = TemplateFactor(measurement, E(0), T_b_lidar=B)
    assert right_only.error(values) == pytest.approx(measurement.error(T @ B), rel=1e-9)


@given(seeds, scales)
def test_callback_factor_between_two_poses(seed, scale):
    rng = np.random.default_rng(seed)
    T_world_target, T_world_lidar = random_pose(rng, scale), random_pose(rng, scale)
    relative = np.linalg.inv(T_world_target) @ T_world_lidar
    measurement = measure(rng, random_pose(rng))
    factor = TemplateCallbackFactor(measurement, L(0), X(0))
    values = values_of(l0=T_world_target, x0=T_world_lidar)
    assert factor.error(values) == pytest.approx(measurement.error(relative), rel=1e-9)
    J, _ = factor.linearize(values).jacobian()
    for block, key in enumerate([L(0), X(0)]):
        np.testing.assert_allclose(
            J[:, 6 * block : 6 * block + 6], jacobian(factor, values, key), atol=1e-7 * np.abs(J).max()
        )


def test_levenberg_marquardt_finds_the_minimum():
    rng = np.random.default_rng(3)
    T = random_pose(rng)
    measurement = measure(rng, T)
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(TemplateFactor(measurement, H(0)))
    start = values_of(h0=retract(T, 0.3 * rng.normal(size=6)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize().atPose3(H(0)).matrix()
    # LM stops at a relative decrease of 1e-5 of the error, which is about 1e-3 sigma here.
    np.testing.assert_allclose(found, minimise(measurement, T), atol=1e-4)


@pytest.mark.parametrize(
    ("result", "message"),
    [
        ((np.zeros(2), [np.zeros((2, 6))]), "expected"),
        ((np.zeros(3), [np.zeros((2, 6))]), "expected"),
        ((np.zeros(3), [np.zeros((3, 5))]), "expected"),
        ((np.zeros(3), [np.zeros(18)]), "expected"),
        ((np.zeros(3), []), "expected"),
        ((np.array([0.0, np.nan, 0.0]), [np.zeros((3, 6))]), "not finite"),
        ((np.zeros(3), [np.full((3, 6), np.inf)]), "not finite"),
    ],
)
def test_a_callback_that_would_crash_gtsam_raises(result, message):
    factor = CheckedFactor(lambda _: result, 3, [X(7)], [6])
    with pytest.raises(EstimationError, match=message) as caught:
        factor.linearize(values_of(x7=np.eye(4)))
    assert "x7" in str(caught.value)


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
