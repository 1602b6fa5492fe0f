"""`optshape simulate`."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph.cli.simulate import command
from optshape_graph.io import load_sensor, load_target, read_scan
from optshape_graph.simulation import pose_from_rpy


def run(tmp_path, *arguments):
    return CliRunner().invoke(command, [*map(str, arguments), "-o", str(tmp_path / "scan.pcd")])


def test_the_cloud_reads_back_and_the_truth_fits_it(tmp_path):
    result = run(tmp_path, "--range", 6, "--rpy", 20, 30, 30)
    assert result.exit_code == 0, result.output
    scan = read_scan(tmp_path / "scan.pcd", load_sensor("vlp32c"))
    truth = json.loads((tmp_path / "scan.json").read_text())
    target, T = load_target("paper"), np.array(truth["T_lidar_target"])
    np.testing.assert_allclose(T, pose_from_rpy([6, 0, 0], np.radians([20, 30, 30])), atol=1e-12)
    np.testing.assert_allclose(truth["vertices"], target.vertices @ T[:3, :3].T + T[:3, 3], atol=1e-12)
    local = (scan.points - T[:3, 3]) @ T[:3, :3]
    assert np.abs(local[:, 0]).max() < 2e-6  # 32-bit coordinates at 6 m
    assert target.outside_distance(local[:, 1:]).max() < 2e-6
    assert truth["targets"][0]["returns"] == len(scan)
    assert scan.ring is not None
    assert scan.intensity is not None
    assert scan.time is not None


def test_parity_mode_gives_the_published_number_of_points(tmp_path):
    assert run(tmp_path, "--range", 2, "--reference").exit_code == 0
    assert len(read_scan(tmp_path / "scan.pcd")) == 2530


def test_same_seed_same_file(tmp_path):
    clouds = []
    for seed in (1, 1, 2):
        result = run(tmp_path, "--range", 8, "--noise", "sensor", "--seed", seed, "--dropout", 0.02, "--force")
        assert result.exit_code == 0
        clouds.append((tmp_path / "scan.pcd").read_bytes())
    assert clouds[0] == clouds[1] != clouds[2]


def test_noise_options_change_parts_of_the_level(tmp_path):
    assert run(tmp_path, "--range", 8, "--noise", 3, "--range-noise", 0.001, "--azimuth-noise-deg", 0.2).exit_code == 0
    noise = json.loads((tmp_path / "scan.json").read_text())["noise"]
    assert noise["range_noise"] == 0.001
    assert np.degrees([noise["azimuth_noise"], noise["elevation_noise"]]) == pytest.approx([0.2, 0.3])


def test_rings_are_left_out(tmp_path):
    assert run(tmp_path, "--range", 8, "--remove-rings", "14,15").exit_code == 0
    assert not set(read_scan(tmp_path / "scan.pcd", load_sensor("vlp32c")).ring) & {14, 15}
    assert run(tmp_path, "--range", 8, "--remove-share", 0.5, "--seed", 4, "--force").exit_code == 0
    left_out = json.loads((tmp_path / "scan.json").read_text())["rings_left_out"]
    assert left_out
    assert not set(read_scan(tmp_path / "scan.pcd", load_sensor("vlp32c")).ring) & set(left_out)


def test_a_scene_with_a_moving_sensor(tmp_path):
    (tmp_path / "scene.yaml").write_text(
        "schema: optshape/scene/1\n"
        "targets:\n  - {target: paper, position: [6, 0, 0]}\n  - {target: diamond, position: [5, 4, 0]}\n"
        "floor: {height: -1.5}\n"
        "boxes:\n  - {size: [30, 20, 8], position: [0, 0, 2]}\n"
        "lidar: {velocity: [2, 0, 0]}\n"
    )
    result = run(tmp_path, "--scene", tmp_path / "scene.yaml", "--spin-rate", 20)
    assert result.exit_code == 0, result.output
    truth = json.loads((tmp_path / "scan.json").read_text())
    assert [target["target"] for target in truth["targets"]] == ["paper", "diamond"]
    assert "vertices" not in truth
    scan = read_scan(tmp_path / "scan.pcd")
    assert len(scan) == 32 * 900
    assert np.ptp(scan.time) == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "either --range"),
        (["--range", 8, "--scene", "x.yaml"], "either --range"),
        (["--scene", "x.yaml", "--reference"], "--reference"),
        (["--range", 8, "--remove-rings", "3,x"], "numbers separated by commas"),
        (["--range", 8, "--remove-rings", "32"], "0 to 31"),
    ],
)
def test_wrong_usage_is_refused(tmp_path, arguments, message):
    result = run(tmp_path, *arguments)
    assert result.exit_code == 2
    assert message in result.output


def test_without_a_return_nothing_is_written(tmp_path):
    from optshape_graph import EstimationError

    result = run(tmp_path, "--range", 9, "--remove-share", 1)
    assert isinstance(result.exception, EstimationError)
    assert not (tmp_path / "scan.pcd").exists()
