import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from optshape_graph.cli.main import cli
from optshape_graph.evaluation.rigs import SimulatedRig, placements, two_targets, write_rig_session


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("rig"))


def write_session(folder: Path) -> Path:
    """A rig of two LiDARs and a camera, five placements of two targets in view of all."""
    rng = np.random.default_rng(5)
    rig = SimulatedRig.drawn(rng, {"front": "vlp16", "rear": "vlp32c"}, ("left",))
    return write_rig_session(folder, rig, two_targets(), placements(5, rng, (0.0, 80.0)), seed=1)


def run(*arguments):
    return CliRunner().invoke(cli, ["calibrate", "rig", *map(str, arguments)], standalone_mode=False)


def changed(session: Path, change, name: str) -> Path:
    """Write the session otherwise, beside itself."""
    document = yaml.safe_load(session.read_text())
    change(document)
    path = session.with_name(name)
    path.write_text(yaml.safe_dump(document))
    return path


def test_writes_everything(session, tmp_path):
    out = tmp_path
    result = run(
        session, "--use-target-points", "--json", out / "rig.json", "--plot", out / "plots", "--export", out / "out",
        "--report", out / "rig.html",
    )  # fmt: skip
    assert result.exception is None, result.exception
    assert result.return_value == 0
    document = json.loads((out / "rig.json").read_text())
    assert document["schema"] == "optshape/rig/1"
    assert len(document["transforms"]) == 3
    for text in ("T_front_rear", "T_rear_front", "rosrun tf2_ros", "ros2 run tf2_ros", "URDF: <origin", "Autoware: "):
        assert text in result.output
    assert sorted(path.name for path in (out / "plots").iterdir()) == ["rig.png", "rings.png", "sightings.png"]
    assert (out / "out" / "sensor_kit_calibration.yaml").exists()
    assert "Calibration of a rig" in (out / "rig.html").read_text()


def test_sensors_that_nothing_connects(session):
    def apart(document):
        for view in document["views"]:
            if view.get("camera"):
                view["stamp"] += 1000.0

    result = run(changed(session, apart, "apart.yaml"), "--use-target-points")
    assert "nothing connects 'left' with 'front', 'rear'" in str(result.exception)
    assert "are the stamps of one clock?" in str(result.exception)


def test_one_placement_only(session):
    def first(document):
        document["views"] = [v for v in document["views"] if v["stamp"] == 0 and v["targets"] == ["A"]]

    result = run(changed(session, first, "first.yaml"), "--use-target-points")
    assert "one placement only" in str(result.exception)


def test_one_sensor_is_no_rig(session):
    def alone(document):
        document["lidars"], document["cameras"] = {"front": document["lidars"]["front"]}, {}
        document["views"] = [v for v in document["views"] if v.get("lidar") == "front"]

    result = run(changed(session, alone, "alone.yaml"), "--use-target-points")
    assert "a rig is of two sensors at least; the session names front alone" in str(result.exception)


def test_a_sensor_file_of_another_model(session):
    def other(document):
        document["lidars"]["rear"] = "vlp16"

    result = run(changed(session, other, "other.yaml"), "--use-target-points")
    assert result.return_value == 3
    assert "scans skipped: unusable file" in result.output
    assert "Not usable: " in result.output


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["lidars"].update(left="vlp16"), "two sensors called 'left'"),
        (lambda d: d.update(platform="flying"), "expected one of: still, moving, found 'flying'"),
        (lambda d: d.update(initial=[{"a": "front", "b": "top", "T_a_b": np.eye(4).tolist()}]), "no sensor 'top'"),
        (lambda d: d.update(initial=[{"a": "front", "b": "front", "T_a_b": np.eye(4).tolist()}]), "another sensor"),
        (lambda d: d.update(initial=[{"a": "front", "b": "rear", "T_a_b": (2 * np.eye(4)).tolist()}]), "initial"),
        (lambda d: d["views"].append({"stamp": 3.0}), "expected 'scan' or 'image' or 'mocap_frame', found only: stamp"),
        (lambda d: d["targets"].update(A={"target": "A.target.yaml", "still": True}), "unknown key 'still'"),
    ],
)
def test_sessions_that_are_refused(session, change, message):
    result = run(changed(session, change, "wrong.yaml"))
    assert message in str(result.exception)


@pytest.mark.parametrize("arguments", [["no.yaml"], []])
def test_bad_usage(arguments):
    assert run(*arguments).exception is not None
