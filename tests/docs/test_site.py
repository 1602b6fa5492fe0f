"""The documentation builds without a warning, from what is here alone, and leaves nothing out."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from optshape_graph.cli.main import COMMANDS
from tests.docs.snippets import ROOT


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built in a folder of its own: the generator builds where its file is."""
    folder = tmp_path_factory.mktemp("docs")
    shutil.copytree(ROOT / "docs", folder / "docs")
    shutil.copy(ROOT / "zensical.toml", folder)
    for name in ("README.md", "optshape_graph"):
        (folder / name).symlink_to(ROOT / name)
    environment = os.environ | {"PYTHONPATH": f"{ROOT / 'docs'}{os.pathsep}{ROOT}"}
    command = [sys.executable, "-m", "zensical", "build", "--strict"]
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    return folder / "build" / "site"


def test_nothing_is_fetched_from_elsewhere(site: Path) -> None:
    fetched = re.compile(
        r"<(?:script|img|iframe)[^>]*\bsrc=\"?(https?:)?//|<link[^>]*rel=\"?stylesheet[^>]*href=\"?https?:"
    )
    assert [page for page in site.rglob("*.html") if fetched.search(page.read_text())] == []


def test_every_layer_is_in_the_reference(site: Path) -> None:
    layers = {path.parent.name for path in (ROOT / "optshape_graph").glob("*/__init__.py")} - {"cli", "compiled"}
    assert {path.stem for path in (site / "reference").glob("*.html")} == layers | {"nouns"}


def test_every_command_is_documented(site: Path) -> None:
    page = (site / "commands.html").read_text()
    assert [name for name in COMMANDS if f"optshape {name} " not in page] == []


def test_search_needs_no_server(site: Path) -> None:
    """Its index is a script, which pages of files may load; and a worker of our own stands for the browser's."""
    assert (site / "search.js").read_text().startswith("var __index")
    page = (site / "guides" / "cpp.html").read_text()
    assert '<script src="../assets/iframe-worker.js">' in page
    assert (site / "assets" / "iframe-worker.js").is_file()
