"""KITTI's and nuScenes' files, written as they are documented: values, rings, and targets found in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from optshape_graph.detection import detect_targets
from optshape_graph.io import load_sensor, load_target, read_scan
from optshape_graph.io.clouds.binary import read_binary
from optshape_graph.io.sensor_guess import guess_sensor
from optshape_graph.scan import Scan
from optshape_graph.simulation import load_scene, simulate

SCENE = """schema: optshape/scene/1
targets:
  - {target: paper, position: [5, 0.5, 0.1], rpy_deg: [5, 10, 10]}
floor: {height: -1.7}
walls:
  - {size: [30, 6], position: [15, 0, 0]}
  - {size: [30, 6], position: [-12, 0, 0], rpy_deg: [0, 0, 180]}
"""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Scan]:
    """A scan of one scene by each of the sensors that the two data sets were recorded with."""
    file = tmp_path_factory.mktemp("scene") / "scene.yaml"
    file.write_text(SCENE)
    scene, T_world_lidar = load_scene(file)
    return {name: simulate(scene, load_sensor(name), T_world_lidar, rng=3).scan for name in ("hdl64e", "hdl32e")}


def kitti(scan: Scan) -> bytes:
    """As KITTI's development kit reads it: 32-bit x, y, z, reflectance; from the uppermost beam down, each beam once
    round from straight ahead, counter-clockwise."""
    assert scan.ring is not None
    azimuth = np.mod(np.arctan2(scan.points[:, 1], scan.points[:, 0]), 2 * np.pi)
    order = np.lexsort((azimuth, -scan.ring))
    return np.column_stack([scan.points, np.full(len(scan), 0.3)])[order].astype("<f4").tobytes()


def nuscenes(scan: Scan) -> bytes:
    """As the devkit of nuScenes reads it: 32-bit x, y, z, intensity, ring; column by column, as the sensor fires."""
    assert scan.ring is not None
    order = np.lexsort((scan.ring, np.arctan2(scan.points[:, 1], scan.points[:, 0])))
    return np.column_stack([scan.points, np.full(len(scan), 7), scan.ring])[order].astype("<f4").tobytes()


def test_a_scan_as_kitti_has_it(tmp_path: Path, scenes: dict[str, Scan]) -> None:
    made = scenes["hdl64e"]
    (tmp_path / "000000.bin").write_bytes(kitti(made))
    sensor = load_sensor("hdl64e")
    scan = read_scan(tmp_path / "000000.bin", sensor)
    azimuth = np.mod(np.arctan2(made.points[:, 1], made.points[:, 0]), 2 * np.pi)
    np.testing.assert_array_equal(scan.ring, made.ring[np.lexsort((azimuth, -made.ring))])
    found = detect_targets(scan, [load_target("paper")]).found
    assert len(found) == 1
    np.testing.assert_allclose(found[0].estimate.T_lidar_target[:3, 3], [5, 0.5, 0.1], rtol=0, atol=0.03)
    unknown = read_scan(tmp_path / "000000.bin")
    np.testing.assert_array_equal(unknown.ring, scan.ring - scan.ring.min())


def test_a_scan_as_nuscenes_has_it(tmp_path: Path, scenes: dict[str, Scan]) -> None:
    (tmp_path / "n.pcd.bin").write_bytes(nuscenes(scenes["hdl32e"]))
    scan = read_scan(tmp_path / "n.pcd.bin")
    guess = guess_sensor(scan)
    assert guess.sensor is not None
    assert guess.sensor.name == "hdl32e"
    scan = read_scan(tmp_path / "n.pcd.bin", guess.sensor)
    np.testing.assert_array_equal(np.bincount(scan.ring), np.bincount(scenes["hdl32e"].ring))
    found = detect_targets(scan, [load_target("paper")]).found
    assert len(found) == 1
    np.testing.assert_allclose(found[0].estimate.T_lidar_target[:3, 3], [5, 0.5, 0.1], rtol=0, atol=0.03)


@given(
    npst.arrays("<f4", st.tuples(st.integers(1, 30), st.just(4)), elements=st.floats(-100, 100, width=32)),
    st.booleans(),
)
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, values: np.ndarray, rings: bool) -> None:
    table = np.column_stack([values, np.arange(len(values)) % 32]).astype("<f4") if rings else values
    path = tmp_path_factory.mktemp("bin") / ("a.pcd.bin" if rings else "a.bin")
    path.write_bytes(table.tobytes())
    if not rings and len(values) % 5 == 0:
        return  # as many bytes as of returns of five values: told by the fifth, and here by chance
    found = read_binary(path).values
    for k, name in enumerate(found):
        np.testing.assert_array_equal(found[name], table[:, k])


@pytest.mark.parametrize("gone", [0.0, 0.02, 0.3])
def test_rings_by_firing_with_returns_lost(tmp_path: Path, scenes: dict[str, Scan], gone: float) -> None:
    made = scenes["hdl64e"].select(np.random.default_rng(1).random(len(scenes["hdl64e"])) >= gone)
    (tmp_path / "a.bin").write_bytes(kitti(made))
    scan = read_scan(tmp_path / "a.bin", load_sensor("hdl64e"))
    azimuth = np.mod(np.arctan2(made.points[:, 1], made.points[:, 0]), 2 * np.pi)
    assert (scan.ring == made.ring[np.lexsort((azimuth, -made.ring))]).mean() > 0.9999


def test_rings_by_firing_of_a_front_view(tmp_path: Path, scenes: dict[str, Scan]) -> None:
    made = scenes["hdl64e"]
    azimuth = np.arctan2(made.points[:, 1], made.points[:, 0])
    made = made.select(np.abs(azimuth) < np.radians(40))
    azimuth = np.arctan2(made.points[:, 1], made.points[:, 0])
    order = np.lexsort((azimuth, -made.ring))
    (tmp_path / "a.bin").write_bytes(np.column_stack([made.points, np.ones(len(made))])[order].astype("<f4").tobytes())
    scan = read_scan(tmp_path / "a.bin", load_sensor("hdl64e"))
    np.testing.assert_array_equal(scan.ring, made.ring[order])
