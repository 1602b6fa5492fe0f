"""`optshape info`: what it says of a file of every kind, in one screen and as JSON."""

# ruff: noqa: E501 - a row is a line

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph import PoseEstimate, estimate_pose
from optshape_graph.cli.main import cli
from optshape_graph.io import load_sensor, load_target, save_sensor, save_target
from optshape_graph.io.describe import describe
from optshape_graph.simulation import pose_from_rpy, simulate_target
from tests.io import test_cameras as cameras
from tests.io import test_oddities as odd
from tests.shared import SHARED, needs_shared


def info(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(cli, ["info", *arguments], standalone_mode=False)
    assert result.exception is None, result.exception
    return result.return_value or 0, result.output


FILES: dict[str, tuple[str, str | bytes, tuple[str, ...]]] = {
    "a cloud": ("a.pcd", odd.pcd(), ("cloud (pcd)", "points", "12", "ring", "uint16 = ring", "4, numbered 0 to 3")),
    "a table": ("a.csv", odd.text("X (mm),Y (mm),Z (mm),RING", *([1000 * v for v in axis] for axis in (odd.X, odd.Y, odd.Z)), odd.RINGS),
                ("cloud (text)", "float64 = x x 0.001", "5.00 to 5.00 m")),
    "floats": ("a.bin", odd.FLOATS.tobytes(), ("cloud (binary)", "float32 = intensity")),
    "a camera": ("a.yaml", cameras.KALIBR, ("camera intrinsics", "cam0", "cam1", "equidistant, 640 x 480")),
    "a maker's sensor": ("a.json", json.dumps(odd.OUSTER), ("sensor, a maker's table", "-10.000 to 10.000 deg", "0.3516 deg")),
    "angles": ("a.csv", "Laser id,Elevation,Azimuth\n1,10,2\n2,0,-1\n3,-10,0.5\n", ("sensor, a maker's table", "rings", "3")),
    "a trajectory": ("a.txt", odd.TUM, ("trajectory (--odometry takes it)", "poses", "2", "10.0 Hz")),
    "EuRoC": ("data.csv", odd.EUROC + odd.LATER, ("trajectory", "from 2023-11-14T22:13:20")),
    "KITTI": ("a.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 2, ("trajectory without stamps (KITTI;", "poses  2")),
    "a pose graph": ("a.txt", "VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1\nFIX 3\n", ("pose graph (g2o;", "vertices  1", "fixed     1")),
    "motion capture": ("a.trc", odd.TRC, ("TRC motion capture", "A, B", "100 Hz", "25.0% of all positions")),
    "rigid bodies": ("a.csv", odd.BODIES.format(kind="Rigid Body"), ("Motive motion capture", "Board", "markers", "none")),
    "markers": ("a.csv", "frame,marker,x,y,z\n0,a,1,2,3\n0,b,1,2.5,3\n", ("markers (session key `mocap`)", "a, b")),
    "markers in millimetres": ("a.csv", "frame,marker,x,y,z\n0,a,1000,2000,3\n0,b,1000,2500,3\n", ("cm or mm",)),
    "corners": ("a.csv", "vertex,u,v\n0,1,2\n", ("pixels of a target's points",)),
    "stamps": ("timestamps.txt", "1\n1.1\n", ("stamps of the files beside it", "1.000 to 1.100 s")),
    "a result": ("a.json", '{"schema": "optshape/estimate/1", "scans": [{}]}', ("optshape/estimate/1", "list of 1")),
    "a report": ("a.html", "<!DOCTYPE html>\n<html></html>", ("web page", "bytes  29")),
    "markers in capitals": ("a.csv", "Frame,Marker,X,Y,Z\n0,a,1,2,3\n0,b,1,2.5,3\n", ("markers (session key `mocap`)", "a, b")),
}  # fmt: skip


def test_a_result_has_statuses_and_a_verdict(tmp_path: Path) -> None:
    target, sensor = load_target("paper"), load_sensor("vlp32c")
    estimate = estimate_pose(simulate_target(target, sensor, pose_from_rpy([5.0, 0.1, 0.0], [0.1, 0.2, 0.1])), target)
    failed = PoseEstimate.failed_entry("b.pcd", "paper", "nothing there")
    document = {"schema": "optshape/estimate/1", "scans": [estimate.to_dict(), failed]}
    (tmp_path / "a.json").write_text(json.dumps(document))
    status, said = info(str(tmp_path / "a.json"))
    assert status == 0
    assert "list of 2, 1 ok, 1 failed" in said
    assert "verdict  Not usable: 1 of 2 scans have a pose to be relied on" in said


@pytest.mark.parametrize("name", FILES)
def test_what_is_said(name: str, tmp_path: Path) -> None:
    file, content, parts = FILES[name]
    path = tmp_path / file
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    status, said = info(str(path))
    assert status == 0
    assert len(said.splitlines()) <= 40
    for part in parts:
        assert part in said


def test_own_files(tmp_path: Path) -> None:
    save_target(tmp_path / "board.yaml", load_target("paper"))
    save_sensor(tmp_path / "lidar.yaml", load_sensor("vlp16"))
    status, said = info(str(tmp_path / "board.yaml"), str(tmp_path / "lidar.yaml"))
    assert status == 0
    assert "optshape/target/1" in said
    assert "optshape/sensor/1" in said
    assert "-15.000 to 15.000 deg" in said


def test_json_and_what_is_not_recognised(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(odd.pcd())
    (tmp_path / "b.dat").write_bytes(b"\0\1\2\3" * 20)
    (tmp_path / "c.txt").write_text("once upon a time\n")
    status, _ = info(
        *(str(tmp_path / name) for name in ("a.pcd", "b.dat", "c.txt")), "--json", str(tmp_path / "i.json")
    )
    assert status == 3
    files = json.loads((tmp_path / "i.json").read_text())["files"]
    assert [file["form"] for file in files] == ["cloud (pcd)", None, None]
    assert files[0]["fields"]["ring"] == "uint16 = ring"
    assert "a binary file of no form that is read here" in files[1]["problem"]
    assert "text of no form that is read here. As a cloud: expected a first line that names" in files[2]["problem"]


def test_columns_may_be_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(odd.PLAIN.split(b"\n", 1)[1])
    status, said = info(str(tmp_path / "a.csv"), "--columns", "x,y,z,ring")
    assert status == 0
    assert "4, numbered 0 to 3" in said


@needs_shared
def test_every_case_in_a_second() -> None:
    files = sorted((SHARED / "cases" / "files").iterdir())
    describe(files[-1])  # imports
    describe(SHARED / "cases" / "files" / "14_tum.txt")
    for file in files:
        start = time.process_time()
        assert describe(file)["form"]
        assert time.process_time() - start < 1.0
    full = SHARED / "data" / "camera" / "scans" / "pose01_full.pcd"
    start = time.process_time()
    facts = describe(full)
    assert time.process_time() - start < 1.0
    assert facts["sensor"].startswith("vlp16")
    assert np.isfinite(facts["returns"])


def test_numbers_beside_the_words(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(odd.pcd())
    (tmp_path / "a.txt").write_text(odd.TUM)
    _, said = info(str(tmp_path / "a.pcd"), str(tmp_path / "a.txt"), "--json", str(tmp_path / "i.json"))
    assert "range_m" not in said
    cloud, trajectory = (file["numbers"] for file in json.loads((tmp_path / "i.json").read_text())["files"])
    assert cloud["points"] == cloud["returns"] == 12
    assert cloud["n_rings"] == 4
    np.testing.assert_allclose(cloud["range_m"], 5.0, atol=0.01)
    assert cloud["elevations_deg"][0] < cloud["elevations_deg"][1]
    assert {"sensor", "misfits_deg", "times_s"} <= cloud.keys()
    assert trajectory["stamps"] == 2
    assert trajectory["rate_hz"] == pytest.approx(10.0, abs=0.01)
    assert trajectory["span_s"][1] - trajectory["span_s"][0] == pytest.approx(0.1, abs=1e-3)
