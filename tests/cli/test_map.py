"""`optshape map`: sessions and recordings in, maps and trajectories out."""

import json
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

import optshape_graph
from optshape_graph import InputError
from optshape_graph.cli.map import command
from optshape_graph.io import load_session, save_sensor, save_target, write_scan
from optshape_graph.io.trajectories import Trajectory, read_g2o, read_tum, write_tum
from optshape_graph.mapping import load_map
from optshape_graph.simulation import pose_from_rpy
from tests.io.recordings.writing import LAYOUTS, maker, write_bag
from tests.mapping.test_recording import SENSOR, TARGET, WHERE, drive

DEMO = Path(optshape_graph.__file__).parent / "data" / "demo" / "session.yaml"


def run(*arguments, code=0):
    result = CliRunner().invoke(command, [str(a) for a in arguments], standalone_mode=False)
    error = result.exception
    said = result.output + (error.format_message() if isinstance(error, click.ClickException) else str(error or ""))
    assert (result.return_value if error is None else 2) == code, said
    return said


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A folder of clouds with timestamps, and the robot's poses."""
    folder = tmp_path_factory.mktemp("drive")
    scans, poses = drive(4)
    for k, stamped in enumerate(scans):
        write_scan(folder / f"{k:04}.pcd", stamped.value)
    (folder / "0009.pcd").write_bytes((folder / "0003.pcd").read_bytes()[:5000])  # a truncated file
    stamps = [stamped.stamp for stamped in scans] + [scans[-1].stamp + 0.1]
    (folder / "timestamps.txt").write_text("".join(f"{stamp:.6f}\n" for stamp in stamps))
    odometry = Trajectory(np.array([p.value for p in poses]), np.array([p.stamp for p in poses]))
    write_tum(folder / "odometry.tum", odometry)
    save_sensor(folder / "lidar.yaml", SENSOR)
    save_target(folder / "board.yaml", TARGET)
    return folder


def test_a_recording_becomes_a_map(recording, tmp_path):
    output = run(
        recording, "--targets", recording / "board.yaml", "--sensor", recording / "lidar.yaml",
        "--json", tmp_path / "map.json", "--tum", tmp_path / "t.tum", "--kitti", tmp_path / "t.kitti",
        "--g2o", tmp_path / "g.g2o", "--plot", tmp_path / "plots",
    )  # fmt: skip
    assert "2 landmarks, 4 poses" in output
    assert "1 scans skipped: unreadable file" in output
    found = load_map(tmp_path / "map.json")
    for landmark in found.landmarks:
        assert min(np.linalg.norm(landmark.T_world_target[:3, 3] - T[:3, 3]) for T in WHERE) < 0.05
        assert landmark.observations >= 3
    [trajectory] = found.trajectories.values()
    np.testing.assert_allclose(read_tum(tmp_path / "t.tum").poses, trajectory.poses, atol=1e-9)
    assert len(read_g2o(tmp_path / "g.g2o").vertices) == 6
    for name in ("map.png", "structure.png"):
        assert (tmp_path / "plots" / name).stat().st_size > 1000
        assert f"picture: {tmp_path / 'plots' / name}" in output

    # The map made is what the next run starts from.
    again = run(
        recording, "--targets", recording / "board.yaml", "--sensor", recording / "lidar.yaml", "--known",
        tmp_path / "map.json", "--lag", 0.5, "--json", tmp_path / "again.json",
    )  # fmt: skip
    assert "2 landmarks" in again
    assert {m.id for m in load_map(tmp_path / "again.json").landmarks} == {m.id for m in found.landmarks}


def test_a_session_without_odometry_is_placed_by_its_target(tmp_path):
    run(DEMO, "--one-each", "--json", tmp_path / "map.json")
    document = json.loads((tmp_path / "map.json").read_text())
    session = load_session(DEMO)
    assert [landmark["id"] for landmark in document["landmarks"]] == [t.name for t in session.targets.values()]
    assert len(document["trajectory"]) == len(session.views)


def test_the_journal_of_a_failed_run_does_not_stop_the_corrected_one(recording, tmp_path):
    arguments = [recording, "--targets", recording / "board.yaml", "--sensor", recording / "lidar.yaml"]
    arguments += ["--json", tmp_path / "map.json", "--workers", "1"]

    def fails(*_, **__):
        raise InputError("a measurement is not finite")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("optshape_graph.mapping.recording.solve_batch", fails)
        assert "not finite" in run(*arguments, "--odometry-noise", "0.5", "5", code=2)
    assert (tmp_path / "map.json.journal").exists()
    assert "2 landmarks" in run(*arguments)
    assert not (tmp_path / "map.json.journal").exists()


def test_nothing_found_is_exit_status_three(recording, tmp_path):
    output = run(recording, "--targets", "triangle@0.05", "--sensor", recording / "lidar.yaml",
                 "--json", tmp_path / "map.json", code=3)  # fmt: skip
    assert "0 landmarks" in output
    assert "no target was seen" in output
    assert load_map(tmp_path / "map.json").landmarks == ()


def test_wrong_usage(recording):
    assert "--targets is needed" in run(recording, code=2)
    assert "names its own targets" in run(DEMO, "--targets", "paper", code=2)
    assert "--as-built needs the batch" in run(DEMO, "--as-built", 0.01, "--no-batch", code=2)


def cloud_of(make, stamped):
    scan = stamped.value
    cloud = np.zeros(len(scan), LAYOUTS["velodyne"])
    cloud["x"], cloud["y"], cloud["z"] = scan.points.T
    cloud["ring"], cloud["time"] = scan.ring, scan.time
    return make.cloud(1e3 + stamped.stamp, cloud)


def bag(folder, scans, poses, T_body_lidar, static):
    """A bag of a LiDAR on a mast, odometry of the base, and, if it is said, where the LiDAR is."""
    make = maker("mcap")
    items = [("/tf_static", make.tf(make.transform(0.0, T_body_lidar, "base", make.header(0.0).frame_id)))] * static
    items += [("/odom", make.odometry(1e3 + p.stamp, p.value @ np.linalg.inv(T_body_lidar))) for p in poses]
    items += [("/points", cloud_of(make, stamped)) for stamped in scans]
    return write_bag(folder, "mcap", items)


@pytest.mark.parametrize("static", [True, False])
def test_odometry_of_the_base_and_a_lidar_on_a_mast(recording, tmp_path, static):
    T_body_lidar = pose_from_rpy([0.8, -0.3, 1.2], np.radians([0.0, 5.0, 90.0]))
    scans, poses = drive(4)
    path = bag(tmp_path, scans, poses, T_body_lidar, static)
    arguments = [path, "--targets", recording / "board.yaml", "--sensor", recording / "lidar.yaml"]
    if static:
        assert "is at (0.800, -0.300, 1.200) m in 'base'" in run(*arguments, "--json", tmp_path / "map.json")
    else:
        output = run(*arguments, code=3)
        assert "no static transform links them" in output
        assert "sightings did not agree on a landmark" in output
        run(*arguments, "--mounting", 0.8, -0.3, 1.2, 0, 5, 90, "--json", tmp_path / "map.json")
    found = load_map(tmp_path / "map.json")
    assert len(found.landmarks) == 2
    for landmark in found.landmarks:
        assert min(np.linalg.norm(landmark.T_world_target[:3, 3] - T[:3, 3]) for T in WHERE) < 0.05


def test_bad_scans_in_a_bag_are_skipped_with_a_reason_and_nothing_else_is_lost(recording, tmp_path):
    scans, poses = drive(4)
    make = maker("mcap")
    good = [cloud_of(make, stamped) for stamped in scans]
    nan = np.zeros(100, LAYOUTS["velodyne"])
    nan["x"] = nan["y"] = nan["z"] = np.nan
    ringless = np.zeros(len(scans[0].value), [(axis, "<f4") for axis in "xyz"])
    ringless["x"], ringless["y"], ringless["z"] = scans[0].value.points.T
    items = [("/odom", make.odometry(1e3 + p.stamp, p.value)) for p in poses]
    items += [
        ("/points", good[0]),
        ("/points", make.cloud(1e3 + 0.10, np.zeros(0, LAYOUTS["velodyne"]))),
        ("/points", make.cloud(1e3 + 0.11, nan)),
        ("/points", make.cloud(1e3 + 0.12, ringless)),
        ("/points", make.serialize(good[1])[:4000]),
        ("/points", good[1]),
        ("/points", good[1]),
        ("/points", good[0]),
        ("/points", good[2]),
        ("/points", good[3]),
    ]
    path = write_bag(tmp_path, "mcap", items, {"/points": "sensor_msgs/msg/PointCloud2"})
    # Six of ten are lost: the map is written, and not to be trusted to show all that was there.
    output = run(path, "--targets", recording / "board.yaml", "--json", tmp_path / "map.json", code=3)
    assert "4 scans, 4 keyframes, 8 sightings: 2 landmarks, 4 poses" in output
    skipped = {line.split(": ")[1] for line in output.splitlines() if "scans skipped" in line}
    assert skipped == {
        "empty", "no returns", "ring missing", "truncated or malformed", "stamp duplicated", "stamp goes backward",
    }  # fmt: skip
