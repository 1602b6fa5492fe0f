"""The reference simulator's clouds, point for point."""

import csv

import numpy as np
import pytest
from scipy.spatial import cKDTree

from optshape_graph import InputError
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target
from optshape_graph.simulation import simulate_target
from optshape_graph.simulation.reference import DISTANCES, ORIENTATIONS, reference_pose, reference_sensor
from tests.shared import SHARED, needs_shared

CONFIGURATIONS = [(distance, name) for name in ORIENTATIONS for distance in DISTANCES]


@needs_shared
def test_point_counts_and_points_equal_the_published_ones_in_all_40_configurations():
    target, sensor = load_target("paper"), reference_sensor()
    published = _published_counts()
    clouds = np.load(SHARED / "reference" / "sim_noisefree_clouds.npz")
    assert len(CONFIGURATIONS) == 40
    for distance, name in CONFIGURATIONS:
        pose = reference_pose(target, distance, ORIENTATIONS[name])
        scan = simulate_target(target, sensor, pose)
        key = f"x{distance:.0f}_{'face' if name == 'face' else 'ext'}"
        assert len(scan) == published[distance, name] == len(clouds[f"{key}_pts"])
        gap, index = cKDTree(clouds[f"{key}_pts"]).query(scan.points)
        # the published vertices have six decimals, and the oblique target amplifies the elevation's rounding
        assert gap.max() < 1e-5
        assert len(np.unique(index)) == len(scan)
        np.testing.assert_array_equal(sensor.n_rings - 1 - scan.ring, clouds[f"{key}_ring"][index])
        vertices = target.vertices @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(vertices, clouds[f"{key}_gtverts"], atol=1e-6)


@needs_shared
def test_reference_sensor_is_the_one_published_with_the_clouds():
    published = load_sensor(SHARED / "reference" / "reference_simulator.sensor.yaml")
    sensor = reference_sensor()
    np.testing.assert_allclose(np.degrees(sensor.elevations), np.degrees(published.elevations), atol=6e-4)  # 3 decimals
    assert sensor.azimuth_step == published.azimuth_step


def test_reference_pose_needs_a_quadrilateral():
    with pytest.raises(InputError, match="3 vertices"):
        reference_pose(load_target("triangle"), 2.0, (0.0, 0.0, 0.0))


def _published_counts():
    with (SHARED / "reference" / "sim_reference.csv").open() as stream:
        return {
            (float(row["x"]), "extreme" if float(row["roll"]) else "face"): int(row["n_points"])
            for row in csv.DictReader(stream)
            if row["noise_level"] == "0"
        }
