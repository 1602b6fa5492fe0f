"""Runs that once went wrong, one by one; each is one of a kind, and the other files here try the kinds."""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.faults.harness import Said, problem_of, run, snapshot
from tests.faults.inputs import make_inputs

ESTIMATE = "estimate 4m.pcd --target target.yaml --sensor sensor.yaml"
DETECT = "detect room.pcd --target square@1 --sensor vlp16"
MAP = "map clouds --targets square@1 --sensor vlp16"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cases") / "outer" / "world"
    folder.parent.mkdir()
    make_inputs(folder)
    return folder


def refused(line: str, world: Path, seconds: float = 20.0) -> str:
    """The error of a run that changes nothing, and ends soon."""
    before, begun = snapshot(world.parents[1]), time.process_time()
    said = run(line.split(), world)
    assert (said.status, problem_of(said)) == (2, ""), said
    assert snapshot(world.parents[1]) == before
    assert time.process_time() - begun < seconds
    return said.err.splitlines()[-1]


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work is not begun."""

    def work(*_: object, **__: object) -> None:
        raise AssertionError("the work was begun")

    for name in ("pose.files.estimate_poses", "detection.files.detect_in_scans", "mapping.observe.detect_in_scans"):
        module, _, function = name.rpartition(".")
        monkeypatch.setattr(f"optshape_graph.{module}.{function}", work)


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("line", [ESTIMATE, DETECT, MAP])
@pytest.mark.parametrize("output", ["no/such/folder/a.json", "/proc/a.json", "clouds", "4m.pcd/a.json"])
def test_an_output_that_cannot_be_written_is_found_before_the_work(line: str, output: str, world: Path) -> None:
    assert "--json" in refused(f"{line} --json {output}", world)


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("options", ["--g2o a.g2o --no-batch", "--g2o a.g2o --lag 3", "--as-built 0.01 --no-batch"])
def test_options_that_do_not_go_together_are_found_before_the_work(options: str, world: Path) -> None:
    assert "needs the batch solution" in refused(f"{MAP} {options}", world)


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("output", ["4m.pcd", "target.yaml", "sensor.yaml", "clouds/../4m.pcd"])
def test_an_input_is_never_an_output(output: str, world: Path) -> None:
    assert "is an input" in refused(f"{ESTIMATE} --json {output}", world)
    assert "is an input" in refused(f"{ESTIMATE} --json {output} --force", world)


@pytest.mark.parametrize("line", [
    "calibrate mocap session.yaml --json markers.csv", "calibrate mocap session.yaml --json 4m.pcd",
    "calibrate camera session.yaml --camchain target.yaml", "map session.yaml --tum markers.csv",
    "map session.yaml --json sensor.yaml", "estimate @list.txt --target target.yaml --json list.txt",
    "simulate --scene scene.yaml --sensor vlp16 -o named.pcd", "extract clouds --sensor vlp16 --target paper -o clouds",
])  # fmt: skip
def test_what_a_session_a_scene_or_a_list_names_is_an_input(line: str, world: Path) -> None:
    (world / "scene.yaml").write_text(
        "schema: optshape/scene/1\ntargets:\n  - {target: named.pcd, position: [8, 0, 0], rpy_deg: [0, 0, 0]}\n"
    )
    (world / "named.pcd").write_bytes((world / "target.yaml").read_bytes())
    error = refused(f"{line} --force" if "extract" not in line else line, world)
    assert "is an input" in error or "is the recording" in error


def test_a_drawing_does_not_replace_its_target(world: Path) -> None:
    line = "design choose --sensor vlp32c --range 6 --rotation 8 --translation 0.1 -o a.pdf"
    assert "expected a target file" in refused(line, world)


def test_somebodys_table_is_kept(world: Path) -> None:
    (world / "table1.csv").write_text("years of work\n")
    assert "--force writes over it" in refused("evaluate paper --draws 1 -o .", world)
    (world / "table1.csv").unlink()


@pytest.mark.usefixtures("idle")
def test_somebodys_export_is_kept(world: Path) -> None:
    (world / "sensor_kit_calibration.yaml").write_text("years of work\n")
    assert "--force writes over it" in refused("calibrate rig session.yaml --export .", world)
    (world / "sensor_kit_calibration.yaml").unlink()


@pytest.mark.parametrize("options", ["--plot out.json.journal", "--report out.json.journal"])
def test_a_journal_is_nobody_elses_output(options: str, world: Path) -> None:
    assert "is the output of --json" in refused(f"{ESTIMATE} --json out.json {options}", world)


def test_a_link_to_an_input_is_that_input(world: Path) -> None:
    (world / "link.json").symlink_to("4m.pcd")
    assert "is an input" in refused(f"{ESTIMATE} --json link.json --force", world)
    (world / "link.json").unlink()


def test_a_drawing_of_a_target_named_as_a_path_stays_here(world: Path) -> None:
    text = (world / "target.yaml").read_text()
    (world / "evil.yaml").write_text("name: ../../evil\n" + "\n".join(x for x in text.splitlines() if x[:5] != "name:"))
    above = {path for path in world.parents[1].rglob("*") if not path.is_relative_to(world)}
    said = run(["design", "export", "evil.yaml", "--format", "svg"], world)
    assert (said.status, problem_of(said)) == (0, "")
    assert {path for path in world.parents[1].rglob("*") if not path.is_relative_to(world)} == above
    assert list(world.glob("*.svg"))


@pytest.mark.parametrize("name", ["front; touch x", "a\nb", "$(touch x)", "\x1b[31mred", "-h", "a b'c\"d"])
def test_frame_names_are_one_word_of_a_shell_line(name: str) -> None:
    from xml.etree import ElementTree

    from optshape_graph.calibration.exports import static_transforms

    lines = static_transforms(name, "front", np.eye(4))
    for ros in ("ros1", "ros2"):
        assert "\n" not in lines[ros]
        assert lines[ros].isprintable()
        words, plain = shlex.split(lines[ros]), shlex.split(static_transforms("lidar", "front", np.eye(4))[ros])
        assert len(words) == len(plain)
        assert [a for a, b in zip(words, plain, strict=True) if a != b and b != "lidar"] == []
    ElementTree.fromstring(f"<x>{lines['urdf']}</x>")


def test_terminal_codes_in_names_are_shown(world: Path) -> None:
    (world / "a\x1b[31m\x07.pcd").write_bytes((world / "4m.pcd").read_bytes())
    text = (world / "target.yaml").read_text().splitlines()
    (world / "loud.yaml").write_text("\n".join(['name: "\\e]0;t\\a\\r"', *(x for x in text if x[:5] != "name:")]))
    for more in ([], ["--debug"]):
        said = run([*more, "estimate", "a\x1b[31m\x07.pcd", "--target", "loud.yaml", "--sensor", "sensor.yaml"], world)
        assert (said.status, problem_of(said)) == (0, "")
        said = run([*more, "estimate", "none\x1b[31m.pcd", "--target", "loud.yaml", "--sensor", "sensor.yaml"], world)
        assert said.status == 2
        assert "\x1b" not in said.err
    (world / "a\x1b[31m\x07.pcd").unlink()


NUMBERS = {
    "design optimise --starts 1 --seed -1 -o a.yaml": "--seed",
    "design study --seed -1 -o study": "--seed",
    f"{MAP} --as-built 0": "--as-built",
    f"{MAP} --odometry-noise 1e300 1e300": "--odometry-noise",
    "simulate --range 5 --sensor vlp16 --spin-rate 1e-9 -o a.pcd": "--spin-rate",
    "simulate --range 5 --sensor fine.yaml -o a.pcd": "rays in a revolution",
    "design optimise --sides 100000 -o a.yaml": "--sides",
    "design export square@2000 --paper a4 --format svg": "sheets",
}


@pytest.mark.parametrize("line", NUMBERS)
def test_numbers_out_of_range_and_work_without_end_are_refused(line: str, world: Path) -> None:
    if "fine.yaml" in line:
        from optshape_graph.io import load_sensor, save_sensor

        save_sensor(world / "fine.yaml", load_sensor("vlp16"))
        text = (world / "fine.yaml").read_text().splitlines()
        assert any(x.startswith("azimuth_step_deg:") for x in text)
        (world / "fine.yaml").write_text(
            "\n".join("azimuth_step_deg: 1.0e-7" if x.startswith("azimuth_step_deg:") else x for x in text)
        )
    assert NUMBERS[line] in refused(line, world)


PIPED = ("info bad.pcd", "estimate bad.pcd --target paper", "detect bad.pcd --target paper --sensor vlp16",
         "view bad.pcd --save a.rrd", "map bad.pcd --targets paper")  # fmt: skip


@pytest.mark.parametrize("line", PIPED)
def test_a_pipe_is_refused_without_waiting(line: str, world: Path) -> None:
    os.mkfifo(world / "bad.pcd")
    said = run(line.split(), world)
    (world / "bad.pcd").unlink()
    assert (said.status, problem_of(said)) == (2, "")
    assert "bad.pcd" in said.err


@pytest.mark.parametrize(("option", "value"), [("method", "Paper"), ("method", ""), ("backend", "Clarabel")])
def test_methods_and_backends_that_are_none_are_refused(option: str, value: str, world: Path) -> None:
    from optshape_graph import InputError, estimate_pose, load_sensor, load_target, read_scan

    scan = read_scan(world / "4m.pcd", load_sensor("vlp32c"))
    with pytest.raises(InputError, match=option):
        estimate_pose(scan, load_target("built"), **{option: value})  # type: ignore[arg-type]  # on purpose


def test_results_on_a_device_leave_nothing_beside_it(world: Path) -> None:
    before = set(Path("/dev").iterdir())
    said: Said = run([*ESTIMATE.split(), "--json", "/dev/null"], world)
    assert (said.status, problem_of(said)) == (0, "")
    assert not {path for path in set(Path("/dev").iterdir()) - before if path.name.endswith(".journal")}


@pytest.mark.parametrize(("missing", "line"), [
    ("matplotlib", "design choose --sensor vlp32c --range 6 --rotation 8 --translation 0.1 -o new.yaml"),
    ("matplotlib", f"{ESTIMATE} --plot pictures"), ("matplotlib", f"{MAP} --plot pictures"),
    ("matplotlib", "calibrate mocap session.yaml --plot pictures"), ("matplotlib", "evaluate paper -o paper"),
    ("matplotlib", "design study -o study"), ("pyarrow", "evaluate simulation -o sweep"),
    ("matplotlib", "evaluate simulation -o sweep"), ("pyarrow", "evaluate mocap . -o e"),
    ("distributed", f"{ESTIMATE} --dask tcp://127.0.0.1:1"), ("rerun", "view 4m.pcd --save a.rrd"),
    ("ezdxf", "design export square --format dxf"),
])  # fmt: skip
def test_an_extra_that_the_end_needs_is_missed_before_the_work(
    missing: str, line: str, world: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == missing]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    assert "pip install 'optshape-graph[" in refused(line, world, seconds=5.0)


def test_json_is_whole_or_not_there(world: Path) -> None:
    said = run([*ESTIMATE.split(), "--json", "whole.json"], world)
    assert said.status == 0
    assert json.loads((world / "whole.json").read_text())["schema"] == "optshape/estimate/1"
    (world / "whole.json").unlink()
