import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, V, W, X
from hypothesis import given

from optshape_graph import EstimationError, InputError, Target
from optshape_graph.factors import (
    FreeVertexFactor,
    LandmarkFactor,
    ShapeFactor,
    ShapeMeasurement,
    TemplatePrior,
    VertexFactor,
    shape_rows,
)
from tests.factors.support import TARGET, edge_points, measure, numerical, random_pose, retract, scales, seeds
from tests.factors.test_template import jacobian, values_of


def shape_measurement(points, edge, sigma=0.01, n=4):
    both = np.vstack([shape_rows(points, edge, n), shape_rows(points, np.full(len(points), n), n)])
    return ShapeMeasurement.from_rows(both / sigma, np.eye(4))


def perturbed(rng, size=0.05):
    return TARGET.vertices + size * rng.normal(size=(4, 3))


@given(seeds, scales)
def test_exact_for_every_pose_and_shape(seed, scale):
    rng = np.random.default_rng(seed)
    T, vertices = random_pose(rng, scale), perturbed(rng)
    points, edge = edge_points(rng, random_pose(rng), 40, noise=0.02)
    measurement = shape_measurement(points, edge)
    shape = Target.from_polygon(vertices[:, 1:])
    moved = points @ T[:3, :3].T + T[:3, 3]
    across = np.einsum("ni,ni->n", shape.normals[edge], moved[:, 1:] - vertices[edge, 1:])
    expected = 0.5 * np.square(np.append(across, moved[:, 0]) / 0.01).sum()
    assert measurement.error(T, vertices) == pytest.approx(expected, rel=1e-9)
    assert measurement.of_template(vertices).error(T) == pytest.approx(expected, rel=1e-9)


@given(seeds, scales)
def test_jacobians(seed, scale):
    rng = np.random.default_rng(seed)
    T, vertices = random_pose(rng, scale), perturbed(rng)
    points, edge = edge_points(rng, random_pose(rng), 20, noise=0.02)
    measurement = shape_measurement(points, edge)
    by_pose, by_vertex = measurement.jacobians(T, vertices)
    scale_of = np.abs(by_pose).max()
    J = numerical(lambda xi: measurement.residual(retract(T, xi), vertices), 6)
    np.testing.assert_allclose(by_pose, J, atol=1e-7 * scale_of)
    J = numerical(lambda d: measurement.residual(T, vertices + d.reshape(4, 3)), 12)
    np.testing.assert_allclose(np.hstack(list(by_vertex)), J, atol=1e-7 * scale_of)


def test_factor_on_a_pair_of_poses():
    rng = np.random.default_rng(3)
    poses = {"l0": random_pose(rng), "x0": random_pose(rng)}
    points, edge = edge_points(rng, random_pose(rng), 20)
    measurement, values = shape_measurement(points, edge), values_of(**poses)
    vertices = perturbed(rng)
    for k, vertex in enumerate(vertices):
        values.insert(V(k), vertex)
    factor = ShapeFactor(measurement, (L(0), X(0)), [V(k) for k in range(4)])
    relative = np.linalg.inv(poses["l0"]) @ poses["x0"]
    assert factor.error(values) == pytest.approx(measurement.error(relative, vertices), rel=1e-9)
    J, _ = factor.linearize(values).jacobian()
    keys = [factor.keys()[i] for i in range(2)]
    for block, key in enumerate(keys):
        np.testing.assert_allclose(
            J[:, 6 * block : 6 * block + 6], jacobian(factor, values, key), atol=1e-7 * np.abs(J).max()
        )


def test_free_vertices_find_the_shape_as_built():
    rng = np.random.default_rng(4)
    built = Target.from_polygon(TARGET.polygon + 0.02 * rng.normal(size=(4, 2)))
    sigma, keys = 0.004, [V(k) for k in range(4)]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, vertex in enumerate(TARGET.vertices):
        graph.push_back(TemplatePrior(vertex, V(k), 0.03))
        values.insert(V(k), vertex)
    for i in range(4):
        T = random_pose(rng)
        points, edge = edge_points(rng, np.linalg.inv(T), 200, built, sigma)
        graph.push_back(ShapeFactor(shape_measurement(points, edge, sigma), X(i), keys))
        values.insert(X(i), gtsam.Pose3(retract(T, 0.02 * rng.normal(size=6))))
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found = np.stack([solution.atPoint3(key) for key in keys])
    np.testing.assert_allclose(found[:, 0], 0.0, atol=1e-6)
    # Shape, not placement: compare the side lengths. 200 points of 4 mm in each of 4 scans give under 1 mm.
    sides = np.linalg.norm(np.roll(found, -1, axis=0) - found, axis=1)
    np.testing.assert_allclose(sides, built.edge_lengths, atol=3e-3)
    assert np.abs(sides - TARGET.edge_lengths).max() > 0.01
    covariance = gtsam.Marginals(graph, solution).jointMarginalCovariance(keys).fullMatrix()
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_rigid_vertices_have_the_covariance_of_the_pose():
    rng = np.random.default_rng(5)
    T_world_target, T_world_lidar = random_pose(rng), random_pose(rng)
    measurement = measure(rng, np.linalg.inv(T_world_target) @ T_world_lidar)
    graph, values = gtsam.NonlinearFactorGraph(), values_of(l0=T_world_target)
    graph.push_back(LandmarkFactor(measurement, L(0), T_world_lidar))
    for k, v in enumerate(TARGET.vertices):
        graph.push_back(VertexFactor(v, L(0), V(k)))
        values.insert(V(k), gtsam.Pose3(T_world_target).transformFrom(v) + 0.05 * rng.normal(size=3))
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, solution)
    pose = solution.atPose3(L(0))
    for k, v in enumerate(TARGET.vertices):
        np.testing.assert_allclose(solution.atPoint3(V(k)), pose.transformFrom(v), atol=1e-6)
        J = numerical(lambda xi, v=v: (retract(pose.matrix(), xi) @ np.append(v, 1.0))[:3], 6)
        expected = J @ marginals.marginalCovariance(L(0)) @ J.T
        # The tie itself adds (0.1 mm)^2, against some (3 mm)^2.
        np.testing.assert_allclose(marginals.marginalCovariance(V(k)), expected, atol=2e-8)
        assert np.trace(expected) > 1e-6


def test_free_vertices_have_places_in_the_world():
    rng = np.random.default_rng(6)
    T = random_pose(rng)
    graph, values = gtsam.NonlinearFactorGraph(), values_of(l0=T)
    graph.push_back(gtsam.PriorFactorPose3(L(0), gtsam.Pose3(T), gtsam.noiseModel.Isotropic.Sigma(6, 0.01)))
    graph.push_back(TemplatePrior(TARGET.vertices[0], V(0), 0.005))
    graph.push_back(FreeVertexFactor(L(0), V(0), W(0)))
    values.insert(V(0), TARGET.vertices[0])
    values.insert(W(0), np.zeros(3))
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    np.testing.assert_allclose(solution.atPoint3(W(0)), gtsam.Pose3(T).transformFrom(TARGET.vertices[0]), atol=1e-6)


def test_bad_input():
    rng = np.random.default_rng(0)
    points, edge = edge_points(rng, np.eye(4), 8)
    measurement = shape_measurement(points, edge)
    with pytest.raises(InputError, match="3 vertex keys for a target of 4 edges"):
        ShapeFactor(measurement, X(0), [V(0), V(1), V(2)])
    with pytest.raises(InputError, match="edges run from 0 to 3; expected 0 to 2"):
        shape_rows(points, edge, 2)
    with pytest.raises(InputError, match="9 columns"):
        ShapeMeasurement(np.eye(9), 1, np.eye(4))
    with pytest.raises(InputError, match="lies at the target's origin"):
        VertexFactor(np.zeros(3), L(0), V(0))
    coincident = TARGET.vertices[[0, 0, 1, 2]]
    factor, values = ShapeFactor(measurement, X(0), [V(k) for k in range(4)]), values_of(x0=np.eye(4))
    for k, vertex in enumerate(coincident):
        values.insert(V(k), vertex)
    with pytest.raises(EstimationError, match="not finite"):
        factor.linearize(values)
