"""The bound with noisy angles, against numerical derivatives of simulated points."""

import numpy as np
import pytest

from optshape_graph.design.bound import _across_rays, covariance_bound
from optshape_graph.io import load_sensor, load_target
from optshape_graph.simulation import pose_from_rpy

TARGET, SENSOR = load_target("paper"), load_sensor("vlp32c")
POSE = pose_from_rpy([8.0, 2.0, 1.0], [0.3, 0.4, -0.2])


def test_how_far_angles_move_points_is_the_derivative():
    rng = np.random.default_rng(0)
    points = np.column_stack([np.zeros(20), rng.uniform(-0.5, 0.5, (20, 2))])
    normals = rng.normal(size=(20, 3))
    lidar = points @ POSE[:3, :3].T + POSE[:3, 3]
    r = np.linalg.norm(lidar, axis=1)
    angles = np.column_stack([np.arctan2(lidar[:, 1], lidar[:, 0]), np.arcsin(lidar[:, 2] / r)])

    def at(azimuth, elevation):
        unit = np.column_stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        return ((r[:, None] * unit - POSE[:3, 3]) @ POSE[:3, :3] * normals).sum(axis=1)

    h = 1e-6
    for k in range(2):
        step = h * np.eye(2)[k]
        slope = (at(*(angles + step).T) - at(*(angles - step).T)) / (2 * h)
        np.testing.assert_allclose(_across_rays(points, normals, POSE)[:, k], slope**2, rtol=1e-6, atol=1e-9)


def test_the_bound_grows_with_the_noise_of_the_angles():
    bounds = [np.diag(covariance_bound(TARGET, SENSOR, POSE, (s, s))) for s in (0.0, 1e-3, 1e-2, 1e-1)]
    assert (np.diff(bounds, axis=0) >= 0).all()
    assert bounds[3][0] / bounds[2][0] == pytest.approx(100, rel=0.2)  # then the angles' noise is nearly all there is
