"""`optshape estimate`: its JSON, its exit statuses, its one-line errors."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph import Scan
from optshape_graph.cli.main import cli
from optshape_graph.io import load_target, write_scan
from tests.pose.clouds import simulated
from tests.pose.rosettes import rosette

KEYS = {
    "scan", "target", "status", "reason", "T_lidar_target", "covariance", "vertices", "certificate", "ambiguity",
    "equivalent_poses", "inset_rad", "labels", "edge_points", "n_returns", "fit",
}  # fmt: skip


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    scan, T = simulated(6.0, (10, 5, 5), 1)
    write_scan(tmp_path / "scan.pcd", scan)
    np.save(tmp_path / "truth.npy", T)
    return tmp_path / "scan.pcd"


def run(*arguments: object) -> "object":
    return CliRunner().invoke(cli, [str(a) for a in arguments], standalone_mode=False)


def test_json(cloud: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(
        cli,
        ["estimate", str(cloud), "--target", "paper", "--sensor", "vlp32c", "--json", str(tmp_path / "out.json")],
        standalone_mode=False,
    )
    assert result.exception is None
    assert result.return_value == 0
    assert "scan.pcd" in result.output
    document = json.loads((tmp_path / "out.json").read_text())
    assert document["schema"] == "optshape/estimate/1"
    (entry,) = document["scans"]
    assert set(entry) == KEYS
    assert entry["scan"] == str(cloud)
    assert entry["status"] == "ok"
    T = np.array(entry["T_lidar_target"])
    np.testing.assert_allclose(T, np.load(tmp_path / "truth.npy"), atol=0.05)
    covariance = np.array(entry["covariance"])
    assert covariance.shape == (6, 6)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    target = load_target("paper")
    np.testing.assert_allclose(entry["vertices"], target.vertices @ T[:3, :3].T + T[:3, 3], atol=1e-9)
    assert entry["certificate"]["certified"] is True
    assert len(entry["labels"]) == len(entry["edge_points"])
    assert set(entry["labels"]) <= {0, 1, 2, 3}
    assert entry["ambiguity"]["margin"] > 5
    np.testing.assert_allclose(entry["equivalent_poses"], [T])


@pytest.mark.parametrize("method", ["global", "paper"])
def test_methods(cloud: Path, method: str) -> None:
    result = CliRunner().invoke(
        cli,
        ["estimate", str(cloud), "--target", "paper", "--sensor", "vlp32c", "--method", method],
        standalone_mode=False,
    )
    assert result.return_value == 0


def test_a_failed_scan_does_not_take_the_others_along(cloud: Path, tmp_path: Path) -> None:
    line = Scan(np.column_stack([np.full(9, 5.0), np.linspace(-1, 1, 9), np.zeros(9)]), np.full(9, 20))
    write_scan(tmp_path / "line.pcd", line)
    result = CliRunner().invoke(
        cli,
        ["estimate", str(cloud), str(tmp_path / "line.pcd"), "--target", "paper", "--json", str(tmp_path / "out.json")],
        standalone_mode=False,
    )
    assert result.return_value == 3
    good, bad = json.loads((tmp_path / "out.json").read_text())["scans"]
    assert good["status"] == "ok"
    assert bad["status"] == "failed"
    assert bad["T_lidar_target"] is None
    assert "on one ring" in bad["reason"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing.pcd", "--target", "paper"], "nothing.pcd"),
        (["{cloud}", "--target", "no-such-target"], "no-such-target"),
        (["{cloud}", "--target", "paper", "--sensor", "no-such-sensor"], "no-such-sensor"),
        (["{cloud}", "--target", "paper", "--sensor", "vlp16"], "vlp16"),
        (["{cloud}"], "--target"),
        (["{cloud}", "--target", "paper", "--method", "guess"], "guess"),
    ],
)
def test_bad_input_is_one_line_and_status_2(cloud: Path, arguments: list[str], message: str) -> None:
    command = [sys.executable, "-m", "optshape_graph", "estimate"]
    filled = [argument.format(cloud=cloud) for argument in arguments]
    result = subprocess.run([*command, *filled], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr


def test_a_cloud_without_rings_and_without_a_sensor(tmp_path: Path) -> None:
    (tmp_path / "bare.csv").write_text("x,y,z\n" + "".join(f"5,{0.05 * k % 1},{0.1 * (k // 20)}\n" for k in range(200)))
    result = CliRunner().invoke(
        cli,
        ["estimate", str(tmp_path / "bare.csv"), "--target", "paper", "--json", str(tmp_path / "out.json")],
        standalone_mode=False,
    )
    assert result.return_value == 3
    (entry,) = json.loads((tmp_path / "out.json").read_text())["scans"]
    assert entry["status"] == "failed"
    assert "rings" in entry["reason"]


def test_a_cloud_without_rings(tmp_path: Path) -> None:
    target = load_target("paper")
    scan, T = rosette(target, 9.0, 8000, 1)
    write_scan(tmp_path / "scan.pcd", scan)
    result = run(
        "estimate", tmp_path / "scan.pcd", "--target", "paper", "--json", tmp_path / "out.json", "--plot", tmp_path
    )
    assert result.exception is None, result.exception
    assert result.return_value == 0
    [entry] = json.loads((tmp_path / "out.json").read_text())["scans"]
    assert entry["inset_rad"] is None
    assert entry["edge_points"] == []
    np.testing.assert_allclose(np.array(entry["T_lidar_target"])[:3, 3], T[:3, 3], atol=0.05)
    assert (tmp_path / "scan_fit.png").exists()
