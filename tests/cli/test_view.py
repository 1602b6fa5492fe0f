"""`optshape view`: recordings that hold what the file holds, and viewers that are told what to show."""

import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph import InputError, MissingExtraError
from optshape_graph.cli.main import cli
from optshape_graph.io import demo_folder, read_scan
from optshape_graph.viz import open3d_view, rerun_view
from optshape_graph.viz.documents import spatial
from optshape_graph.viz.spatial import Points
from tests.viz.results import write_results

DEMO = demo_folder()


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_results(tmp_path_factory.mktemp("results"))


def view(*arguments: object):
    return CliRunner().invoke(cli, ["view", *map(str, arguments)], standalone_mode=False)


def recorded(path: Path) -> dict[str, list]:
    """Chunks of a recording, by entity."""
    from rerun.chunk import RrdReader

    chunks: dict[str, list] = {}
    for chunk in RrdReader(path).stream().collect().stream():
        chunks.setdefault(chunk.entity_path, []).append(chunk)
    return chunks


def entity(name: str) -> str:
    import rerun

    return "/" + "/".join(rerun.escape_entity_path_part(part) for part in name.split("/"))


@pytest.mark.parametrize("kind", ["estimate", "detect", "map", "mocap", "simulation"])
def test_a_recording_holds_all_there_is_to_see(results, kind, tmp_path):
    pytest.importorskip("rerun")
    result = view(results[kind], "--save", tmp_path / "out.rrd")
    assert result.exception is None, result.exception
    assert f"recording: {tmp_path / 'out.rrd'}" in result.output
    seen, chunks = spatial(results[kind]), recorded(tmp_path / "out.rrd")
    assert {entity(item.name) for item in seen.items} <= set(chunks)
    for step, name in enumerate(seen.steps):
        assert "/about" in chunks, (step, name)


def test_a_recording_of_a_scan_holds_its_points(tmp_path):
    pytest.importorskip("rerun")
    assert view(DEMO / "4m.pcd", "--save", tmp_path / "scan.rrd").exception is None
    (chunk,) = recorded(tmp_path / "scan.rrd")["/scan"]
    column = chunk.to_record_batch().column("Points3D:positions")
    points = np.array(column.to_pylist()[0])
    np.testing.assert_allclose(points, read_scan(DEMO / "4m.pcd").points, atol=1e-5)
    assert [path.name for path in tmp_path.iterdir()] == ["scan.rrd"]


def test_another_ending_is_refused(tmp_path):
    result = view(DEMO / "4m.pcd", "--save", tmp_path / "scan.png")
    assert isinstance(result.exception, InputError)
    assert "ends in .rrd" in str(result.exception)


def test_an_absent_rerun_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    result = view(DEMO / "4m.pcd", "--save", tmp_path / "scan.rrd")
    assert isinstance(result.exception, MissingExtraError)
    assert "pip install 'optshape-graph[view]'" in str(result.exception)


def test_without_save_a_viewer_is_opened(monkeypatch):
    opened = []
    monkeypatch.setattr(rerun_view, "open_viewer", lambda seen, name: opened.append((seen, name)))
    assert view(DEMO / "4m.pcd").exception is None
    assert opened[0][1] == "4m.pcd"


def test_a_viewer_that_cannot_start_is_one_line(monkeypatch):
    pytest.importorskip("rerun")
    commands = []

    class Viewer:
        returncode = 3

        def __init__(self, command, **_):
            commands.append(command)

        def poll(self):
            return self.returncode

    monkeypatch.setattr("subprocess.Popen", Viewer)
    monkeypatch.setenv("DISPLAY", ":0")
    result = view(DEMO / "4m.pcd")
    assert isinstance(result.exception, InputError)
    assert "could not be started (it ended with exit status 3); write a file instead: --save" in str(result.exception)
    assert commands[0][1:5] == ["-m", "rerun", "--bind", "127.0.0.1"]  # others on the network see nothing


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there always is a screen")
@pytest.mark.parametrize(("library", "option"), [("rerun", ()), ("open3d", ("--open3d",))])
def test_without_a_screen_no_viewer_is_started(monkeypatch, library, option):
    pytest.importorskip(library)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    result = view(DEMO / "4m.pcd", *option)
    assert isinstance(result.exception, InputError)
    assert "no screen" in str(result.exception)


def test_open3d_gets_the_scan_that_was_asked_for(results, monkeypatch):
    shown = []
    monkeypatch.setattr(open3d_view, "show", lambda seen, step, name: shown.append((seen, step, name)))
    assert view(results["estimate"], "--open3d", "--scan", 1).exception is None
    assert shown[0][1:] == (1, "estimate.json")
    assert "scans 0 to 1, found 2" in str(view(results["estimate"], "--open3d", "--scan", 2).exception.format_message())
    assert view(results["estimate"], "--open3d", "--save", "a.rrd").exception is not None


def test_open3d_geometries_are_those_of_the_step(results):
    pytest.importorskip("open3d")
    seen = spatial(results["estimate"])
    shapes = open3d_view.geometries(seen, 1)
    wanted = [item for item in seen.items if item.step in (None, 1)]
    assert len(shapes) == len(wanted)
    for shape, item in zip(shapes, wanted, strict=True):
        points = item.points if isinstance(item, Points) else np.vstack(item.strips)
        np.testing.assert_allclose(np.asarray(shape.points), points)
        if not isinstance(item, Points):
            assert len(shape.lines) == len(points) - len(item.strips)
            assert len(shape.colors) == len(shape.lines)


def test_open3d_without_a_window_is_one_line(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    open3d = pytest.importorskip("open3d")
    monkeypatch.setattr(open3d.visualization.Visualizer, "create_window", lambda self, **_: False)
    result = view(DEMO / "4m.pcd", "--open3d")
    assert isinstance(result.exception, InputError)
    assert "could not open a window" in str(result.exception)
