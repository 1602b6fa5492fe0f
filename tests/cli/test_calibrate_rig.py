import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from optshape_graph.cli.main import cli
from optshape_graph.errors import OptshapeError
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


def of(sensor, document):
    """The views of one sensor."""
    return [view for view in document["views"] if sensor in (view.get("lidar"), view.get("camera"))]


def shift(sensor, seconds):
    def change(document):
        for view in of(sensor, document):
            view["stamp"] += seconds

    return change


def connected_by_nothing(document):
    document["views"] = [view for view in document["views"] if (view in of("left", document)) == (view["stamp"] > 2)]


def one_placement(document):
    document["views"] = [view for view in document["views"] if view["stamp"] == 0 and view["targets"] == ["A"]]


def one_sensor(document):
    document["lidars"], document["cameras"] = {"front": document["lidars"]["front"]}, {}
    document["views"] = of("front", document)


def without_stamps(document):
    for view in document["views"]:
        del view["stamp"]


def missing_file(document):
    of("left", document)[0]["image"] = "no.csv"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (shift("rear", 1), "the stamps of 'rear' are 1 s ahead of those of 'front', 'left': "),
        (shift("left", -1), "the stamps of 'left' are 1 s behind those of 'front', 'rear': "),
        (shift("front", 37.4), "the stamps of 'front' are 37.4 s ahead of those of 'rear', 'left': "),
        (shift("left", -1e9), "the stamps of 'left' are 1e+09 s behind those of 'front', 'rear': "),
        (connected_by_nothing, "nothing connects 'left' with 'front', 'rear': "),
        (one_placement, "one placement only (00_front_A.pcd); a rig calibration needs two at least"),
        (one_sensor, "a rig is of two sensors at least; the session names front alone"),
        (without_stamps, "no view has a 'stamp': those of one stamp see the same scene"),
        (missing_file, "image: no such file: "),
        (
            lambda document: document["lidars"].update(rear="vlp16"),
            "the sensor file of 'rear' (vlp16) is of another model: it is for vlp16, and 9 of 10 scans do not fit its "
            "elevations; 00_rear_A.pcd: the cloud has 19 rings, the sensor 16",
        ),
    ],
)
def test_sessions_that_are_refused_in_one_line(session, change, message):
    """What is wrong is named, and the session's file with it."""
    path = changed(session, change, "refused.yaml")
    error = run(path, "--use-target-points").exception
    assert isinstance(error, OptshapeError)
    assert str(error).startswith(f"{path}:")
    assert message in str(error)
    assert "\n" not in str(error)


def test_a_file_that_is_empty_is_named(session):
    def empty(document):
        (session.parent / "empty.pcd").write_text("")
        of("rear", document)[0].update(scan="empty.pcd", target_points="empty.pcd")

    result = run(changed(session, empty, "with_empty.yaml"), "--use-target-points")
    assert result.return_value == 0
    assert "1 file of the session cannot be used; the first: " in result.output
    assert "empty.pcd" in result.output


def test_vertices_numbered_backwards_are_named(session):
    def backwards(document):
        target = yaml.safe_load((session.parent / "A.target.yaml").read_text())
        target["vertices"] = target["vertices"][::-1]
        (session.parent / "backwards.target.yaml").write_text(yaml.safe_dump(target))
        document["targets"]["A"] = "backwards.target.yaml"

    error = run(changed(session, backwards, "turned.yaml"), "--use-target-points").exception
    assert "backwards.target.yaml:" in str(error)
    assert "vertices run clockwise; expected counter-clockwise" in str(error)


def test_a_target_whose_file_is_of_another_size_is_named(session):
    def larger(document):
        target = yaml.safe_load((session.parent / "A.target.yaml").read_text())
        target["vertices"] = [[1.1 * x for x in vertex] for vertex in target["vertices"]]
        (session.parent / "larger.target.yaml").write_text(yaml.safe_dump(target))
        document["targets"]["A"] = "larger.target.yaml"

    result = run(changed(session, larger, "larger.yaml"), "--use-target-points")
    assert result.return_value == 3
    assert "the sides of target 'A' are" in result.output
    assert "% shorter than its file says" in result.output


def test_targets_that_moved_though_they_were_said_to_stay_are_named_once(session):
    def static(document):
        document["targets"] = {name: {"target": file, "static": True} for name, file in document["targets"].items()}

    result = run(changed(session, static, "static.yaml"), "--use-target-points")
    assert result.return_value == 0
    for name in "AB":
        said = f"target '{name}' was said to stay, but moved 4 times, first by "
        assert result.output.replace("\n", " ").count(said) in (1, 2)  # the first is in the verdict, too


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
