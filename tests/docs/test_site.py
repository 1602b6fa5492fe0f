"""The documentation builds without a warning, from what is here alone, and leaves nothing out."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from optshape_graph.cli.main import COMMANDS
from tests.docs.snippets import ROOT


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return folder


def test_nothing_is_fetched_from_elsewhere(site: Path) -> None:
    fetched = re.compile(
        r"<(?:script|img|iframe)[^>]*\bsrc=\"?(https?:)?//|<link[^>]*rel=\"?stylesheet[^>]*href=\"?https?:"
    )
    assert [page for page in site.rglob("*.html") if fetched.search(page.read_text())] == []


def test_every_layer_is_in_the_reference(site: Path) -> None:
    layers = {path.parent.name for path in (ROOT / "optshape_graph").glob("*/__init__.py")} - {"cli"}
    assert {path.stem for path in (site / "reference").glob("*.html")} == layers | {"nouns"}


def test_every_command_is_documented(site: Path) -> None:
    page = (site / "commands.html").read_text()
    assert [name for name in COMMANDS if f"optshape {name} " not in page] == []
