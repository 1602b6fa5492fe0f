"""Every command and every Python snippet of README and documentation runs as printed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import click
import pytest

from optshape_graph.cli.main import COMMANDS, cli
from tests.docs.examples import EXAMPLES
from tests.docs.snippets import PAGES, ROOT, blocks

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


@each_page
def test_blocks_run_as_printed(page: Path, tmp_path: Path) -> None:
    found = blocks(page)
    assert {block.language for block in found} <= {"sh", "python", "yaml", "json", "text", "bibtex", "csv"}
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, "-m", "tests.docs.run_page", str(page)]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, f"{result.stdout[-3000:]}\n{result.stderr[-3000:]}"


@each_page
def test_what_sets_up_the_system_is_there(page: Path) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for line in "\n".join(block.text for block in blocks(page) if block.language == "sh").splitlines():
        command = line.split("#")[0].replace("-C optshape_graph", "").split()
        if command[:1] == ["make"]:
            subprocess.run(["make", "--dry-run", *command[1:]], cwd=ROOT, check=True, capture_output=True)
        for names in re.findall(r"(?:optshape-graph|\.)\[(.*?)\]", line):
            assert set(names.split(",")) <= set(extras), line


@each_page
def test_pictures_are_there(page: Path) -> None:
    for path in re.findall(r"!\[[^\]]+\]\(([^)]+)\)", page.read_text()):
        assert (page.parent / path).is_file(), path


def test_examples_are_used() -> None:
    text = "\n".join(block.text for page in PAGES for block in blocks(page))
    assert [name for name in EXAMPLES if name not in text] == []


@cache
def options() -> set[str]:
    """All options of all commands."""

    def of(command: click.Command, context: click.Context) -> set[str]:
        found = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                inner = command.get_command(context, name)
                assert inner is not None
                found |= of(inner, click.Context(inner, parent=context))
        return found

    return of(cli, click.Context(cli)) | {"--help"}


@each_page
def test_what_pages_name_exists(page: Path) -> None:
    text = re.sub(r"pip install[^\n`]*|dask (scheduler|worker)[^`]*", "", page.read_text())  # options of others
    assert set(re.findall(r"`optshape ([a-z]+)", text)) <= set(COMMANDS)
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]+", text)) <= options()
    for name in re.findall(r"`(?:notebooks/)?(\d\d_\w+\.ipynb)`", text):
        assert (ROOT / "notebooks" / name).is_file(), name


def test_messages_of_troubleshooting_are_those_of_the_package() -> None:
    text = "".join(path.read_text() for path in sorted((ROOT / "optshape_graph").rglob("*.py")))
    said = re.sub(r'"\s*\n\s*f?"', "", text)  # strings over several lines
    page = (ROOT / "docs" / "guides" / "troubleshooting.md").read_text()
    quoted = [part for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE) for part in re.findall(r"`(.+?)`", row)]
    assert len(quoted) > 40
    assert [message for message in quoted for part in message.split("…") if part.strip() not in said] == []


def test_every_figure_and_table_of_the_paper_has_a_row() -> None:
    page = (ROOT / "docs" / "paper.md").read_text()
    rows = re.findall(r"^\| (Figures?|Table) ([^,|]+)", page, re.MULTILINE)
    numbers = {int(n) for kind, text in rows if kind.startswith("Figure") for n in re.findall(r"\d+", text)}
    assert numbers == set(range(1, 15))
    assert {text.strip() for kind, text in rows if kind == "Table"} == {"I", "II"}


def test_from_nothing_to_the_first_pose_of_an_own_target_are_ten_commands_at_most() -> None:
    """They run in `test_blocks_run_as_printed`, but for those that set up the system."""
    page = ROOT / "docs" / "guides" / "first-target.md"
    lines = "\n".join(block.text for block in blocks(page) if block.language == "sh").replace("\\\n", " ").splitlines()
    commands = [line for line in lines if line.strip()]
    assert len(commands) <= 10
    assert commands[0].startswith("git clone")
    assert commands[-1].startswith("optshape estimate first.pcd --target built.yaml")
