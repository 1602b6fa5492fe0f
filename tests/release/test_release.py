"""Wheel and source distribution: what is in them, and that the wheel works with no repository beside it."""

from __future__ import annotations

import email
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest
from packaging.version import Version

import optshape_graph

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The source distribution, and the wheel that is built of it."""
    folder = tmp_path_factory.mktemp("dist")
    own_tools = ["--no-isolation"] if find_spec("hatchling") else []  # otherwise pip fetches them
    command = [sys.executable, "-m", "build", *own_tools, "--outdir", str(folder), str(ROOT)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return folder


def wheel(dist: Path) -> Path:
    [path] = dist.glob("*.whl")
    return path


def test_wheel_holds_the_package_and_its_data(dist: Path) -> None:
    with zipfile.ZipFile(wheel(dist)) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
    package = ROOT / "optshape_graph"
    expected = {
        str(path.relative_to(ROOT))
        for path in package.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix not in (".pyc", ".so")
    }
    library = "optshape_graph/compiled/library.so"
    assert packed - {library} == expected
    # With a compiler the wheel has the library, for one platform; without, it is for all.
    compiled = shutil.which("cc") is not None
    assert (library in packed) == compiled
    assert wheel(dist).stem.endswith("-py3-none-any") != compiled
    assert {"optshape_graph/py.typed", "optshape_graph/factors/__init__.py"} <= packed


def test_wheel_says_what_the_project_says(dist: Path) -> None:
    with zipfile.ZipFile(wheel(dist)) as archive:
        [metadata] = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        said = email.message_from_bytes(archive.read(metadata))
        entry_points = archive.read(metadata.replace("METADATA", "entry_points.txt")).decode()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert said["Version"] == optshape_graph.__version__
    assert set(said.get_all("Provides-Extra")) == set(project["optional-dependencies"])
    assert said["License-Expression"] == "Apache-2.0"
    assert "optshape = optshape_graph.cli.entry:main" in entry_points


def test_source_distribution_holds_what_is_needed_to_test_and_document_it(dist: Path) -> None:
    [path] = dist.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames()}
    assert {"README.md", "CHANGELOG.md", "LICENSE", "Makefile", "zensical.toml", "docs/index.md"} <= names
    assert "tests/release/smoke.py" in names
    assert not [name for name in names if name.startswith(("build/", "dist/", ".venv/"))]


def test_wheel_works_without_the_repository(dist: Path, tmp_path: Path) -> None:
    installed, elsewhere = tmp_path / "installed", tmp_path / "elsewhere"
    elsewhere.mkdir()
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", installed]
    subprocess.run([*command, wheel(dist)], check=True, capture_output=True)
    assert (installed / "bin" / "optshape").is_file()
    environment = os.environ | {"PYTHONPATH": str(installed)}
    command = [sys.executable, ROOT / "tests" / "release" / "smoke.py"]
    result = subprocess.run(command, cwd=elsewhere, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert str(installed) in result.stdout


def test_changelog_has_this_version() -> None:
    versions = re.findall(
        r"^## \[(.*?)\](?: - (\d{4}-\d{2}-\d{2}))?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE
    )
    assert versions[0][0] == "Unreleased"
    released, version = (Version(text) for text in (versions[1][0], optshape_graph.__version__))
    assert version == released or (version.is_devrelease and version > released)
    assert all(date for _, date in versions[1:])
