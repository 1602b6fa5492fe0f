"""The documentation builds without a warning, from what is here alone, and leaves nothing out."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from optshape_graph.cli.lazy import LazyGroup
from optshape_graph.cli.main import cli
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


def test_every_command_is_documented() -> None:
    documented = set(
        re.findall(r"^<!-- help: (.*) -->$", (ROOT / "docs" / "commands.md").read_text(), flags=re.MULTILINE)
    )
    assert set(commands(cli)) == documented


def commands(group: LazyGroup, prefix: str = "") -> list[str]:
    """All commands that do something, with the groups that they are in."""
    import click

    found = []
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        inner = isinstance(command, click.Group)
        found += commands(command, f"{prefix}{name} ") if inner else [f"{prefix}{name}"]
    return found
