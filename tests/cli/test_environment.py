"""What is installed is found out without being brought down by it."""

import re
import tomllib
from pathlib import Path

import pytest

from optshape_graph.cli import environment
from optshape_graph.cli.environment import Found, import_all, missing_libraries, requirements, satisfies

ROOT = Path(__file__).resolve().parents[2]


def test_every_extra_has_a_purpose():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(extras) - {"test"} <= set(environment.PURPOSES)


def test_the_core_is_what_pyproject_says():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {line.split(">")[0] for line in project["dependencies"]} == set(environment.CORE)
    assert set(requirements()[""]) == set(environment.CORE)
    assert requirements()[""]["gtsam"] in (">=4.3,<4.4", "<4.4,>=4.3")
    assert "matplotlib" in requirements()["plot"]


def test_without_metadata_the_core_is_known(monkeypatch):
    monkeypatch.setattr(environment, "DISTRIBUTION", "no-such-distribution")
    assert set(requirements()[""]) == set(environment.CORE)


def test_system_libraries_are_those_of_the_setup():
    pairs = re.findall(r"(lib[\w.-]+\.so\.\d+):([\w.-]+)", (ROOT / ".ci/setup").read_text())
    assert dict(pairs) == environment.SYSTEM
    assert missing_libraries({"libno-such.so.7": "libno-such7"}) == {"libno-such.so.7": "libno-such7"}
    assert missing_libraries({}) == {}


@pytest.mark.parametrize(
    ("version", "wanted", "within"),
    [
        ("4.3.0", ">=4.3,<4.4", True), ("4.4", ">=4.3,<4.4", False), ("4.2.9", ">=4.3,<4.4", False),
        ("10.0", ">=9", True), ("2.0rc1", ">=2.0", True), ("1.5", "==1.5", True), ("1.5", "!=1.5", False),
        ("1.5", ">1.5", False), ("1.5", "<=1.5", True), ("1.9", "~=1.5", True), ("2.0", "~=1.5", False),
        ("1", "", True),
    ],
)  # fmt: skip
def test_versions_and_bounds(version, wanted, within):
    assert satisfies(version, wanted) is within


def test_a_module_that_ends_the_process_is_a_finding(tmp_path, monkeypatch):
    (tmp_path / "crashes.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    (tmp_path / "leaves.py").write_text("import os\nos._exit(3)\n")
    (tmp_path / "raises.py").write_text("print('noise')\nraise OSError('libX.so.9: cannot open shared object file')\n")
    (tmp_path / "fine.py").write_text("__version__ = '1.2'\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    found = import_all(["crashes", "leaves", "raises", "fine", "no-such-module", "click"])
    assert found["crashes"] == Found(None, "importing it ended the process with signal 11")
    assert found["leaves"] == Found(None, "importing it ended the process")
    assert found["raises"] == Found(None, "OSError: libX.so.9: cannot open shared object file")
    assert found["fine"] == Found("1.2")
    assert found["no-such-module"] == Found(None)
    assert found["click"].version


def test_a_module_that_hangs_is_a_finding(tmp_path, monkeypatch):
    (tmp_path / "hangs.py").write_text("import time\ntime.sleep(60)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(environment, "SECONDS", 1)
    found = import_all(["hangs"])
    assert found["hangs"].error == "importing it took more than 1 s"
