import dataclasses

import numpy as np
import pytest

from optshape_graph import InputError, SensorModel
from optshape_graph.design.bound import _by_azimuth, covariance_bound, pose_bound, pose_information
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target
from optshape_graph.simulation import pose_from_rpy

OBLIQUE = pose_from_rpy([8.0, 2.0, 1.0], [0.3, 0.4, -0.2])


@pytest.fixture(scope="module")
def sensor():
    return load_sensor("vlp32c")


@pytest.fixture(scope="module")
def target():
    return load_target("paper")


def facing(distance, roll=0.0, height=0.0, yaw=0.0):
    c, s, cy, sy = np.cos(roll), np.sin(roll), np.cos(yaw), np.sin(yaw)
    T = np.eye(4)
    T[:3, :3] = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    T[:3, 3] = distance, 0.0, height
    return T


def test_information_of_ideal_edges_by_hand():
    """Without range noise and bias, edges alone count in the plane: the sum of n n^T over their variances."""
    target = load_target("diamond")
    sensor = SensorModel(np.radians(np.arange(-3.0, 3.5, 1.0)), "s", np.radians(0.01), 0.02, 0.0)
    information = pose_information(target, sensor, facing(10.0))
    expected = np.zeros((2, 2))
    for elevation in sensor.elevations:
        z = 10.0 * np.tan(elevation)
        for side in (1, -1):
            normal = np.array([side, np.sign(z) or 1.0]) / np.sqrt(2)
            per_radian = 10.0  # face-on, in the middle
            variance = (normal[0] * per_radian * sensor.azimuth_step) ** 2 / 12
            beam = np.array([10.0, side * (np.sqrt(0.5) - abs(z)), z])
            variance += ((beam[1:] @ normal) / np.linalg.norm(beam) * 0.02) ** 2
            expected += np.outer(normal, normal) / variance
    if np.isclose(sensor.elevations, 0).any():
        # The ring through the corners meets one of two edges there.
        expected[0, 1] = expected[1, 0] = information[4, 5]
    # The step along a ring grows by (1 + tan^2) of the azimuth, up to 0.5 %; rings are slightly bent.
    np.testing.assert_allclose(information[4:, 4:], expected, rtol=0.02)


def test_it_is_what_the_rows_of_the_factors_say(target, sensor):
    """The derivative of the factors' rows to a right perturbation, against q x n and n."""
    from optshape_graph.factors import edge_rows

    T = facing(8.0, 0.4, 0.1, 0.3)
    rng = np.random.default_rng(0)
    q = np.column_stack([np.zeros(5), rng.normal(size=(5, 2))])
    n = rng.normal(size=(5, 2))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    points = q @ T[:3, :3].T + T[:3, 3]
    A, r = edge_rows(points, n, (n * q[:, 1:]).sum(axis=1))

    def residual(xi):
        import gtsam

        H = gtsam.Pose3(T).retract(xi).inverse().matrix()
        return A @ np.concatenate([H[:3, :3].ravel(order="F"), H[:3, 3]]) + r

    h = 1e-6
    numeric = np.column_stack([(residual(h * e) - residual(-h * e)) / (2 * h) for e in np.eye(6)])
    normals = np.column_stack([np.zeros(5), n])
    np.testing.assert_allclose(numeric, -np.hstack([np.cross(q, normals), normals]), atol=1e-8)


def test_covariance_is_the_scatter_of_the_best_estimate(target, sensor):
    """Simulate the very noise, estimate by weighted least squares: the scatter is the bound (chi-square, 400 draws)."""
    from optshape_graph.design import bound as module

    T = facing(6.0, 0.3, 0.05)
    covariance = covariance_bound(target, sensor, T)
    rays = module._rays(target, sensor, T)
    n_edge, q_edge, beam_edge, ring_edge, s_edge = module._ring_ends(target, rays)
    normals = np.concatenate([n_edge, np.tile([1.0, 0.0, 0.0], (int(rays.inside.sum()), 1))])
    points = np.concatenate([q_edge, rays.points[rays.inside]])
    beams = np.concatenate([beam_edge, rays.directions[rays.inside]])
    ring = np.concatenate([ring_edge, np.nonzero(rays.inside)[0]])
    J = np.hstack([np.cross(points, normals), normals])
    per_range = (beams * normals).sum(axis=1)
    along = np.zeros(len(J))
    along[: len(n_edge)] = (s_edge * n_edge).sum(axis=1)
    width = np.zeros(len(J))
    ranges = np.linalg.norm(q_edge @ T[:3, :3].T + T[:3, 3], axis=1)
    width[: len(n_edge)] = sensor.beam_aperture + sensor.beam_divergence * ranges
    rng = np.random.default_rng(1)
    C = np.diag((per_range * sensor.range_noise) ** 2 + (along * sensor.azimuth_step) ** 2 / 12 + width**2 / 12)
    C += sensor.ring_bias**2 * np.outer(per_range, per_range) * (ring[:, None] == ring) + np.outer(width, width) / 12
    gain = np.linalg.solve(J.T @ np.linalg.solve(C, J), np.linalg.solve(C, J).T)
    step = sensor.azimuth_step
    squares = []
    for _ in range(400):
        noise = per_range * (
            rng.normal(0, sensor.range_noise, len(J)) + rng.normal(0, sensor.ring_bias, sensor.n_rings)[ring]
        )
        noise += along * rng.uniform(-step / 2, step / 2, len(J))
        noise += width * (rng.uniform(-0.5, 0.5) + rng.uniform(-0.5, 0.5, len(J)))
        error = gain @ noise
        squares.append(error @ np.linalg.solve(covariance, error))
    # Mean of 400 chi-squares of 6 degrees: 6 +- 0.17 (one sigma).
    assert np.mean(squares) == pytest.approx(6.0, abs=0.7)


def test_more_information_lowers_the_bound(target, sensor):
    T = facing(10.0, 0.2, 0.1)
    base = covariance_bound(target, sensor, T)
    for change in (
        {"ring_bias": 0.0}, {"range_noise": 0.003}, {"azimuth_step": 0.5 * sensor.azimuth_step},
        {"beam_aperture": 0.0}, {"beam_divergence": 0.0},
    ):  # fmt: skip
        better = covariance_bound(target, dataclasses.replace(sensor, **change), T)
        # Halving the step also doubles the returns.
        assert np.linalg.eigvalsh(base - better).min() > -1e-12


def test_an_upright_square_is_not_determined(sensor):
    found = pose_bound(load_target("square"), sensor, 10.0, turns=4, placements=1)
    assert found.e_t[1] == np.inf
    assert pose_bound(load_target("paper"), sensor, 10.0, turns=4, placements=1).e_t[1] < 0.1


def test_no_ring_no_pose(target):
    sensor = SensorModel(np.radians([30.0, 40.0]), "high", 0.01)
    assert np.isinf(covariance_bound(target, sensor, facing(10.0))).all()


def test_bound_grows_with_distance(target, sensor):
    near, far = (pose_bound(target, sensor, distance, turns=6, placements=2) for distance in (5.0, 20.0))
    assert far.e_t[0] > near.e_t[0]
    assert far.e_in_plane[0] > 2 * near.e_in_plane[0]


def test_misuse_is_refused(target, sensor):
    with pytest.raises(InputError, match="azimuth step"):
        covariance_bound(target, sensor.with_azimuth_step(None), facing(5.0))
    with pytest.raises(InputError, match="-x side"):
        covariance_bound(target, sensor, facing(5.0, yaw=np.pi))
    with pytest.raises(InputError, match="positive distance; found 0"):
        pose_bound(target, sensor, 0.0)


def test_how_far_azimuths_move_points_is_the_derivative():
    rng = np.random.default_rng(0)
    points = np.column_stack([np.zeros(20), rng.uniform(-0.5, 0.5, (20, 2))])
    normals = rng.normal(size=(20, 3))
    lidar = points @ OBLIQUE[:3, :3].T + OBLIQUE[:3, 3]

    def along_normals(turn):
        R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        return ((lidar @ R.T - OBLIQUE[:3, 3]) @ OBLIQUE[:3, :3] * normals).sum(axis=1)

    slope = (along_normals(1e-6) - along_normals(-1e-6)) / 2e-6
    np.testing.assert_allclose(_by_azimuth(points, normals, OBLIQUE), slope, rtol=1e-6, atol=1e-9)


def test_bound_grows_with_the_noise_of_the_azimuths(target, sensor):
    bounds = [np.diag(covariance_bound(target, sensor, OBLIQUE, noise)) for noise in (0.0, 1e-3, 1e-2, 1e-1)]
    assert (np.diff(bounds, axis=0) >= 0).all()
    assert bounds[3][0] / bounds[2][0] == pytest.approx(100, rel=0.2)  # then the azimuths' noise is nearly all there is
