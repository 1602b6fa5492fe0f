import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from hypothesis import given

from optshape_graph.factors import (
    LandmarkFactor,
    SummaryFactor,
    TemplateCallbackFactor,
    TemplateMeasurement,
    edge_rows,
    plane_rows,
    summarise,
)
from tests.factors.support import TARGET, edge_points, log, measure, minimise, random_pose, retract, scales, seeds
from tests.factors.test_template import values_of


@given(seeds, scales)
def test_linearises_as_the_exact_factor_where_it_was_made(seed, scale):
    rng = np.random.default_rng(seed)
    T_world_target, T_world_lidar = random_pose(rng, scale), random_pose(rng, scale)
    at = np.linalg.inv(T_world_target) @ T_world_lidar
    measurement = measure(rng, retract(at, 0.1 * rng.normal(size=6)))
    values = values_of(l0=T_world_target, x0=T_world_lidar)
    exact = TemplateCallbackFactor(measurement, L(0), X(0)).linearize(values)
    summary = SummaryFactor(measurement, L(0), X(0), at)
    linear = summary.linearize(values)
    scale_of = np.abs(exact.information()).max()
    np.testing.assert_allclose(linear.information(), exact.information(), atol=1e-8 * scale_of)
    gradients = [A.T @ b for A, b in (linear.jacobian(), exact.jacobian())]
    np.testing.assert_allclose(*gradients, atol=1e-7 * np.abs(gradients[1]).max())
    # The floor is what the summary leaves out, so the errors at the pose agree too.
    floor = summarise([measurement], at[None])[0].floor
    assert summary.error(values) + floor == pytest.approx(measurement.error(at), rel=1e-7)


@given(seeds)
def test_taken_at_its_minimum_it_measures_that_pose_with_its_information(seed):
    rng = np.random.default_rng(seed)
    T = random_pose(rng)
    measurement = measure(rng, T)
    best = minimise(measurement, T)
    [summary] = summarise([measurement], best[None])
    np.testing.assert_allclose(summary.T_target_lidar, best, atol=1e-9)
    S, information = summary.sqrt_information, measurement.information(best)
    np.testing.assert_allclose(S.T @ S, information, atol=1e-7 * np.abs(information).max())
    assert summary.floor == pytest.approx(measurement.error(best), rel=1e-8)


@given(seeds)
def test_landmark_factor_is_the_summary_with_the_lidar_known(seed):
    rng = np.random.default_rng(seed)
    T_world_target, T_world_lidar = random_pose(rng), random_pose(rng)
    at = np.linalg.inv(T_world_target) @ T_world_lidar
    measurement = measure(rng, retract(at, 0.05 * rng.normal(size=6)))
    values = values_of(l0=retract(T_world_target, 0.05 * rng.normal(size=6)), x0=T_world_lidar)
    both = SummaryFactor(measurement, L(0), X(0), at)
    one = LandmarkFactor(measurement, L(0), T_world_lidar, at)
    assert one.error(values) == pytest.approx(both.error(values), rel=1e-9)
    information = both.linearize(values).information()[:6, :6]
    np.testing.assert_allclose(one.linearize(values).information(), information, atol=1e-8 * np.abs(information).max())


def test_many_are_summarised_as_one_by_one():
    rng = np.random.default_rng(2)
    poses = np.stack([random_pose(rng) for _ in range(5)])
    measurements = [measure(rng, T) for T in poses]
    away = np.stack([retract(T, 0.05 * rng.normal(size=6)) for T in poses])
    together = summarise(measurements, away)
    for i, measurement in enumerate(measurements):
        [alone] = summarise([measurement], away[i : i + 1])
        np.testing.assert_allclose(together[i].T_target_lidar, alone.T_target_lidar, atol=1e-12)
        np.testing.assert_allclose(together[i].sqrt_information, alone.sqrt_information, rtol=1e-9, atol=1e-6)
        assert together[i].floor == pytest.approx(alone.floor)


def test_one_visible_edge_leaves_its_direction_unmeasured():
    rng = np.random.default_rng(4)
    T = random_pose(rng)
    points, edge = edge_points(rng, np.linalg.inv(T), 40)
    seen = edge == 0
    A, r = edge_rows(points[seen], TARGET.normals[edge[seen]], TARGET.offsets[edge[seen]])
    P, s = plane_rows(points)
    measurement = TemplateMeasurement.from_rows(np.vstack([A, P]) / 0.01, np.append(r, s) / 0.01, T)
    [away] = summarise([measurement], retract(T, 0.01 * rng.normal(size=6))[None])
    assert np.isfinite(away.T_target_lidar).all()
    [summary] = summarise([measurement])
    S = summary.sqrt_information
    values, vectors = np.linalg.eigh(S.T @ S)
    assert values[0] < 1e-9 * values[-1] < 1e-3 * values[1]
    # The edge slides along itself: a translation in the LiDAR frame, by the rotated edge direction.
    along = np.append(0.0, [-TARGET.normals[0, 1], TARGET.normals[0, 0]])
    assert abs(vectors[3:, 0] @ (T[:3, :3].T @ along)) == pytest.approx(1.0, abs=1e-6)


def test_far_from_the_measurement_it_is_made_where_the_measurement_was_taken():
    rng = np.random.default_rng(5)
    T = random_pose(rng)
    measurement = measure(rng, T)
    turned = retract(T, np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]))
    [far], [own] = summarise([measurement], turned[None]), summarise([measurement])
    np.testing.assert_allclose(far.T_target_lidar, own.T_target_lidar)
    assert summarise([]) == []


def test_it_serialises_and_takes_a_robust_loss():
    rng = np.random.default_rng(6)
    T = random_pose(rng)
    measurement = measure(rng, T)
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(SummaryFactor(measurement, L(0), X(0)))
    copy = gtsam.NonlinearFactorGraph()
    copy.deserialize(graph.serialize())
    values = values_of(l0=np.eye(4), x0=retract(T, 0.1 * rng.normal(size=6)))
    assert copy.error(values) == pytest.approx(graph.error(values), rel=1e-9)

    huber = gtsam.noiseModel.mEstimator.Huber.Create(3.0)
    robust = SummaryFactor(measurement, L(0), X(0), loss=huber)
    distance = np.sqrt(2 * graph.error(values))
    assert distance > 3.0
    assert robust.error(values) == pytest.approx(3.0 * (distance - 1.5), rel=1e-6)


def test_covariance_is_consistent_with_the_scatter_of_estimates():
    rng = np.random.default_rng(7)
    T = random_pose(rng)
    nees = []
    for _ in range(300):
        measurement = measure(rng, T, n=24)
        best = minimise(measurement, T, 6)
        error = log(np.linalg.inv(T) @ best)
        nees.append(error @ measurement.information(best) @ error)
    # The mean of 300 chi-square(6) has standard deviation sqrt(12 / 300) = 0.2: five of them.
    assert np.mean(nees) == pytest.approx(6.0, abs=1.0)
