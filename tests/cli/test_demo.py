"""`optshape demo`: a result and pictures in a folder, and what one sees in them."""

import json
import sys

import pytest
from click.testing import CliRunner

from optshape_graph import InputError
from optshape_graph.cli.main import cli


def test_demo_writes_what_it_explains(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(cli, ["demo"], standalone_mode=False)
    assert result.exception is None, result.exception
    assert result.return_value == 0
    written = sorted(path.name for path in (tmp_path / "optshape-demo").iterdir())
    assert written == ["errors.png", "fit.png", "markers.png", "mocap.json", "placements.png"]
    for name in written:
        assert f"\n  {name} " in result.output
    assert json.loads((tmp_path / "optshape-demo/mocap.json").read_text())["mean"]["rmse_m"] < 0.02
    assert result.output.rstrip().endswith("Look at optshape-demo/fit.png first.")


def test_without_matplotlib_there_is_the_result(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    result = CliRunner().invoke(cli, ["demo", "-o", str(tmp_path / "out")], standalone_mode=False)
    assert result.exception is None, result.exception
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mocap.json"]
    assert "no pictures: " in result.stderr
    assert "pip install 'optshape-graph[plot]'" in result.stderr


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(cli, ["demo", "-o", str(tmp_path / "file/out")], standalone_mode=False)
    assert isinstance(result.exception, InputError)
    assert "file is a file, not a folder" in str(result.exception)
