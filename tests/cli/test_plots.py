"""`--plot DIR`: the pictures of every command, told by name, and refused before the work where they cannot be drawn."""

import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

pytest.importorskip("matplotlib")

import optshape_graph
from optshape_graph import MissingExtraError
from optshape_graph.cli.main import cli
from optshape_graph.cli.plots import names_of

DEMO = Path(optshape_graph.__file__).parent / "data/demo"
ESTIMATE = ["estimate", DEMO / "4m.pcd", "--target", DEMO / "target.yaml", "--sensor", "vlp32c"]


def run(*arguments: object):
    return CliRunner().invoke(cli, [str(a) for a in arguments], standalone_mode=False)


def drawn(result, folder: Path) -> set[str]:
    """Names of the pictures, which are PNG and were told."""
    assert result.exception is None, result.exception
    told = [Path(line.removeprefix("picture: ")) for line in result.output.splitlines() if line.startswith("picture: ")]
    assert {path.name for path in told} == {path.name for path in folder.iterdir()}
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in told)
    return {path.name for path in told}


def test_estimate(tmp_path):
    result = run(*ESTIMATE, "--plot", tmp_path / "p")
    assert drawn(result, tmp_path / "p") == {f"4m_{kind}.png" for kind in ("fit", "edges", "residuals", "vertices")}


def test_detect_and_simulate(tmp_path):
    (tmp_path / "scene.yaml").write_text(
        "schema: optshape/scene/1\n"
        "targets: [{target: paper, position: [6, 0, 0], rpy_deg: [10, 5, 20]}]\n"
        "floor: {height: -1.5}\nwalls: [{size: [12, 4], position: [9, 0, 0]}]\n"
    )
    made = run("simulate", "--scene", tmp_path / "scene.yaml", "-o", tmp_path / "a.pcd", "--plot", tmp_path / "s")
    assert drawn(made, tmp_path / "s") == {"a.png"}
    found = run("detect", tmp_path / "a.pcd", "--target", "paper", "--sensor", "vlp32c", "--plot", tmp_path / "d")
    assert drawn(found, tmp_path / "d") == {"a.png", "a_0_paper.png"}


def test_a_target_s_name_does_not_lead_out_of_the_folder(tmp_path):
    (tmp_path / "in").mkdir()
    board = (DEMO / "target.yaml").read_text().replace("name: built", 'name: "../../../outside"')
    (tmp_path / "in/board.yaml").write_text(board)
    scene = "schema: optshape/scene/1\ntargets: [{target: board.yaml, position: [4, 0, 0], rpy_deg: [10, 5, 20]}]\n"
    (tmp_path / "in/scene.yaml").write_text(
        scene + "floor: {height: -1.5}\nwalls: [{size: [12, 4], position: [9, 0, 0]}]\n"
    )
    made = run("simulate", "--scene", tmp_path / "in/scene.yaml", "-o", tmp_path / "in/a.pcd")
    assert made.exception is None, made.exception
    found = run("detect", tmp_path / "in/a.pcd", "--target", tmp_path / "in/board.yaml", "--sensor", "vlp32c",
                "--plot", tmp_path / "in/p")  # fmt: skip
    assert drawn(found, tmp_path / "in/p") == {"a.png", "a_0_.._.._.._outside.png"}
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_calibrate_and_evaluate_mocap(tmp_path):
    result = run("calibrate", "mocap", DEMO / "session.yaml", "--plot", tmp_path / "c")
    assert drawn(result, tmp_path / "c") == {"errors.png", "placements.png", "markers.png"}
    result = run("evaluate", "mocap", DEMO, "-o", tmp_path / "e", "--plot", tmp_path / "f")
    assert drawn(result, tmp_path / "f") == {"errors.png"}


def test_a_file_in_place_of_a_folder_is_refused(tmp_path):
    result = run(*ESTIMATE, "--plot", tmp_path / "picture.png")
    assert "expected a folder" in str(result.exception.format_message())
    assert not list(tmp_path.iterdir())


def test_an_absent_matplotlib_is_told_before_the_work(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    result = run(*ESTIMATE, "--plot", tmp_path / "p", "--json", tmp_path / "out.json")
    assert isinstance(result.exception, MissingExtraError)
    assert not list(tmp_path.iterdir())


def test_scans_of_one_name_do_not_overwrite_each_other():
    paths = ["a/scan.pcd", "b/scan.pcd", "b/other.pcd"]
    assert list(names_of(paths).values()) == ["000_scan", "001_scan", "other"]


def test_pictures_in_the_format_asked_for(tmp_path):
    from click.testing import CliRunner

    from optshape_graph.cli.estimate import command
    from optshape_graph.io.builtin import demo_folder

    demo = demo_folder()
    arguments = [demo / "4m.pcd", "--target", demo / "target.yaml", "--sensor", demo / "sensor.yaml",
                 "--plot", tmp_path / "p", "--plot-format", "svg", "--report", tmp_path / "r.html"]  # fmt: skip
    result = CliRunner().invoke(command, list(map(str, arguments)), catch_exceptions=False, standalone_mode=False)
    assert result.return_value == 0, result.output
    assert {path.suffix for path in (tmp_path / "p").iterdir()} == {".svg"}
    assert "data:image/svg+xml;base64," in (tmp_path / "r.html").read_text()
    assert "Good: 1 of 1 scan has" in result.output
