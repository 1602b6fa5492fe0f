"""`optshape doctor`: says what is there, what works, what to do, and fails only where the core does."""

import itertools
import json
import re
import tomllib
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import pytest
from click.testing import CliRunner

from optshape_graph.cli import environment
from optshape_graph.cli.environment import Found
from optshape_graph.cli.main import cli
from optshape_graph.evaluation import self_check
from tests.io.schema_support import complaint

ROOT = Path(__file__).resolve().parents[2]

REQUIRED = {
    "": dict.fromkeys(environment.CORE, ">=1"),
    "plot": {"matplotlib": ">=3.8,<4"},
    "mesh": {"open3d": ">=0.19"},
    "ros": {"rosbags": ">=0.11,<0.12"},
}
ALL = {name: Found("9.0") for name in environment.CORE} | {
    "matplotlib": Found("3.9"), "open3d": Found("0.20"), "rosbags": Found("0.11.1"),
}  # fmt: skip


def doctor(monkeypatch, tmp_path, found=None, missing=None):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(environment, "requirements", lambda: REQUIRED)
    monkeypatch.setattr(environment, "import_all", lambda names: ALL | (found or {}))
    monkeypatch.setattr(environment, "missing_libraries", lambda: missing or {})
    result = CliRunner().invoke(cli, ["doctor", "--json", str(tmp_path / "out.json")], standalone_mode=False)
    assert result.exception is None, result.exception
    document = json.loads((tmp_path / "out.json").read_text())
    assert document["schema"] == "optshape/doctor/1"
    assert complaint(tmp_path / "out.json") is None
    checks = {check["name"]: check for check in document["checks"]}
    for check in checks.values():
        assert (check["status"] == "ok") == (check["to_do"] == "")
        assert check["name"] in result.output
        assert check["to_do"] in result.output
    assert document["works"] is (result.return_value == 0)
    return result, checks


def test_all_well(monkeypatch, tmp_path):
    result, checks = doctor(monkeypatch, tmp_path)
    assert result.return_value == 0
    assert {check["status"] for name, check in checks.items() if name != "compiled library"} == {"ok"}
    assert "The core works, and every extra is there." in result.output
    assert "certified" in checks["self-check"]["found"]


def test_absent_extras_are_no_failure_and_one_command_brings_them(monkeypatch, tmp_path):
    found = {"matplotlib": Found(None), "rosbags": Found("0.10.0"), "open3d": Found(None, "OSError: libGL.so.1")}
    result, checks = doctor(monkeypatch, tmp_path, found, {"libGL.so.1": "libgl1"})
    assert result.return_value == 0
    assert checks["extra plot"]["status"] == "absent"
    assert checks["extra plot"]["to_do"] == "pip install 'optshape-graph[plot]'"
    assert checks["extra ros"]["status"] == "broken"
    assert "rosbags 0.10.0, where >=0.11,<0.12 is needed" in checks["extra ros"]["found"]
    assert "libGL.so.1" in checks["extra mesh"]["found"]
    assert "apt-get install libgl1" in checks["system libraries"]["to_do"]
    assert "pip install 'optshape-graph[plot,ros,mesh]'" in result.output


@pytest.mark.parametrize("found", [{"gtsam": Found(None)}, {"gtsam": Found("0.9")}, {"numpy": Found(None, "boom")}])
def test_a_broken_core_is_a_failure(monkeypatch, tmp_path, found):
    result, checks = doctor(monkeypatch, tmp_path, found)
    assert result.return_value == 1
    (name,) = found
    assert checks[name]["status"] == "broken"
    assert f"pip install --force-reinstall '{name}>=1'" in result.output
    assert f"The core does not work: {name}" in result.output


def test_a_self_check_that_goes_wrong_is_a_failure(monkeypatch, tmp_path):
    monkeypatch.setattr(self_check, "estimate_pose", lambda *_: 1 / 0)
    result, checks = doctor(monkeypatch, tmp_path)
    assert result.return_value == 1
    assert checks["self-check"]["found"] == "ZeroDivisionError: division by zero"


def test_threads_are_advised(monkeypatch, tmp_path):
    doctor(monkeypatch, tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    result = CliRunner().invoke(cli, ["doctor"], standalone_mode=False)
    assert result.return_value == 0
    assert "export OMP_NUM_THREADS=1" in result.output


def test_the_real_installation_works():
    result = CliRunner().invoke(cli, ["doctor"], standalone_mode=False)
    assert result.exception is None
    assert result.return_value == 0, result.output


def test_every_extra_is_known_and_its_packages_go_by_the_modules_that_they_bring():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(project) - {"test"} == set(environment.PURPOSES)
    for requirement in itertools.chain(*project.values()):
        name = re.match(r"[A-Za-z0-9._-]+", requirement)[0]
        installed = name != environment.DISTRIBUTION and any(metadata.distributions(name=name))
        if installed and not name.startswith(("pytest-", "types-", "scipy-stubs")):
            assert find_spec(environment.MODULES.get(name, name.replace("-", "_"))), name
