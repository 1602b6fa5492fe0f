"""Angular noise: seen, taken out of the elevations, and without bias in what is left."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from optshape_graph import SensorModel
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.pose.angles import level_rings
from optshape_graph.simulation import NoiseModel
from tests.pose.clouds import simulated


def sensor_without_beam() -> SensorModel:
    return replace(load_sensor("vlp32c"), range_noise=0.01, ring_bias=0.0, beam_divergence=0.0, beam_aperture=0.0)


def test_exact_angles_are_left_alone() -> None:
    scan, _ = simulated(8.0, seed=1)
    leveled, noise = level_rings(scan)
    assert leveled is scan
    assert noise == 0.0


@pytest.mark.parametrize("noise_deg", [0.1, 0.3])
def test_noise_is_found_and_elevations_are_put_right(noise_deg: float) -> None:
    noise = NoiseModel(range_noise=0.01, azimuth_noise=np.radians(noise_deg), elevation_noise=np.radians(noise_deg))
    scan, _ = simulated(6.0, seed=2, sensor=sensor_without_beam(), noise=noise)
    assert scan.sensor is not None
    assert scan.ring is not None
    leveled, found = level_rings(scan)
    # Several hundred returns: the standard deviation is known to a few per cent.
    assert found == pytest.approx(np.radians(noise_deg), rel=0.1)
    elevation = np.arcsin(leveled.points[:, 2] / np.linalg.norm(leveled.points, axis=1))
    np.testing.assert_allclose(elevation, scan.sensor.elevations[scan.ring], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(leveled.points, axis=1), np.linalg.norm(scan.points, axis=1), rtol=1e-12)


def test_no_bias_of_a_tilted_plane() -> None:
    """Azimuth errors move a return along the plane and off it; the normalised tilt errors' mean stays 0 (sd 0.16)."""
    target, level = load_target("paper"), NoiseModel.level(3).jittered()
    sensor = replace(sensor_without_beam(), range_noise=level.range_noise)
    normalised = []
    for seed in range(40):
        scan, T = simulated(8.0, (20, 30, 30), seed, sensor=sensor, noise=level)
        estimate = estimate_pose(scan, target)
        xi = gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(estimate.T_lidar_target) @ T))
        normalised.append(xi / np.sqrt(np.diag(estimate.covariance)))
    assert np.abs(np.mean(normalised, axis=0)[1:3]).max() < 4 * 0.16
