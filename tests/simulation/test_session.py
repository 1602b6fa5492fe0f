"""Synthetic sessions, and the one that is bundled."""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from optshape_graph import EstimationError
from optshape_graph.io import load_sensor, load_target, read_scan
from optshape_graph.io.documents import read_json, read_yaml
from optshape_graph.simulation import synthetic_session
from optshape_graph.simulation.session import MARKER_NOISE, MARKER_OFFSET


def check(folder: Path) -> None:
    """What the session's files say is consistent with its truth."""
    truth = read_json(folder / "truth.json").value
    session = read_yaml(folder / "session.yaml").value
    target, sensor = load_target(folder / "target.yaml"), load_sensor(folder / "sensor.yaml")
    T_lidar_mocap = np.array(truth["T_lidar_mocap"])
    markers = np.genfromtxt(folder / "markers.csv", delimiter=",", skip_header=1, usecols=(0, 2, 3, 4))
    for view in session["scans"]:
        T = np.array(truth["T_lidar_target"][view["file"]])
        scan = read_scan(folder / view["file"], sensor)
        local = (scan.points - T[:3, 3]) @ T[:3, :3]
        assert len(scan) > 30
        assert np.abs(local[:, 0]).max() < 6 * np.hypot(sensor.range_noise, sensor.ring_bias)
        seen = markers[markers[:, 0] == view["mocap_frame"], 1:] @ T_lidar_mocap[:3, :3].T + T_lidar_mocap[:3, 3]
        offset = (seen - T[:3, 3]) @ T[:3, :3] - target.vertices
        np.testing.assert_allclose(np.linalg.norm(offset, axis=1), MARKER_OFFSET, atol=6 * MARKER_NOISE)
        np.testing.assert_allclose(offset + target.vertices, truth["markers_in_target"], atol=6 * MARKER_NOISE)


def test_a_synthetic_session_is_consistent_and_reproducible(tmp_path):
    target, sensor = load_target("built"), load_sensor("vlp32c")
    for name in "ab":
        synthetic_session(tmp_path / name, target, sensor, distances=(4.0, 7.5), rng=3)
    check(tmp_path / "a")
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


def test_a_target_out_of_reach_is_an_error(tmp_path):
    sensor = load_sensor("vlp32c")
    with pytest.raises(EstimationError, match="no ray"):
        synthetic_session(tmp_path, load_target("paper@0.0001"), sensor, distances=(400.0,))


def test_the_bundled_session_is_consistent_and_small():
    folder = Path(str(files("optshape_graph") / "data" / "demo"))
    check(folder)
    assert sum(file.stat().st_size for file in folder.iterdir()) < 300_000
