import dataclasses

import numpy as np
import pytest

from optshape_graph import InputError, SensorModel
from optshape_graph.design.bound import covariance_bound, measured_rows, pose_bound, pose_information
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
    T = facing(6.0, 0.3, 0.05)
    covariance = covariance_bound(target, sensor, T)
    rows = measured_rows(target, sensor, T[None])
    used = rows.weight[0] > 0
    ring = np.nonzero(used)[0]
    J, own, bias, shared = rows.J[0][used], rows.weight[0][used] ** -0.5, rows.bias[0][used], rows.shared[0][used]
    C = np.diag(own**2) + np.outer(bias, bias) * (ring[:, None] == ring) + np.outer(shared, shared)
    gain = np.linalg.solve(J.T @ np.linalg.solve(C, J), np.linalg.solve(C, J).T)
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(400):
        noise = own * rng.normal(size=len(J)) + bias * rng.normal(size=ring.max() + 1)[ring]
        error = gain @ (noise + shared * rng.normal())
        squares.append(error @ np.linalg.solve(covariance, error))
    # Mean of 400 chi-squares of 6 degrees: 6 +- 0.17 (one sigma).
    assert np.mean(squares) == pytest.approx(6.0, abs=0.7)


def test_chords_have_the_moments_of_the_returns_between_their_ends(target, sensor):
    """Against every ray of a fine sensor, one by one: the information of the plane's returns alone."""
    fine = dataclasses.replace(sensor, azimuth_step=np.radians(0.01), ring_bias=0.0, beam_aperture=1e3)
    information = pose_information(target, fine, OBLIQUE)
    R, t = OBLIQUE[:3, :3], OBLIQUE[:3, 3]
    azimuths = np.arange(np.arctan2(t[1], t[0]) - 0.3, np.arctan2(t[1], t[0]) + 0.3, fine.azimuth_step)
    elevation, azimuth = (grid.ravel() for grid in np.meshgrid(fine.elevations, azimuths))
    beams = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    directions, origin = beams @ R, -R.T @ t
    points = origin - directions * (origin[0] / directions[:, :1])
    inside = target.contains(points[:, 1:])
    n = np.array([1.0, 0.0, 0.0])
    J = np.hstack([np.cross(points[inside], n), np.tile(n, (int(inside.sum()), 1))])
    expected = J.T @ (J / (directions[inside, :1] * fine.range_noise) ** 2)
    seen = [1, 2, 3]  # edges are blind: the beam is a kilometre wide
    scale = np.sqrt(np.diag(expected)[seen])
    # A ring is not quite straight, and the incidence changes along it: 2 % of a standard deviation.
    error = (information - expected)[np.ix_(seen, seen)] / np.outer(scale, scale)
    np.testing.assert_allclose(error, 0.0, atol=0.04)


def test_bounds_of_many_poses_are_those_of_each(target, sensor):
    poses = np.stack([OBLIQUE, facing(10.0, 0.2, 0.1), facing(30.0, 2.0)])
    each = [covariance_bound(target, sensor, T) for T in poses]
    np.testing.assert_allclose(covariance_bound(target, sensor, poses), each, rtol=1e-6)


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


def test_bound_grows_with_the_noise_of_the_azimuths(target, sensor):
    bounds = [np.diag(covariance_bound(target, sensor, OBLIQUE, noise)) for noise in (0.0, 1e-3, 1e-2, 1e-1)]
    assert (np.diff(bounds, axis=0) >= 0).all()
    assert bounds[3][0] / bounds[2][0] == pytest.approx(100, rel=0.2)  # then the azimuths' noise is nearly all there is
