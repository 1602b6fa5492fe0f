"""What pages take from the package itself when the documentation is built: each command's help, each file's schema."""

from __future__ import annotations

import re
from typing import Any

HELP = re.compile(r"^<!-- help:(.*?)-->$", flags=re.MULTILINE)
"""A line that the help of a command replaces."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put what the package says in place of the marks of a page."""
    return HELP.sub(lambda match: f"\n```text\n{command_help(match.group(1).split())}```\n", markdown)


def command_help(command: list[str]) -> str:
    """Return what `optshape COMMAND --help` prints."""
    from click.testing import CliRunner

    from optshape_graph.cli.main import cli

    result = CliRunner().invoke(cli, [*command, "--help"], prog_name="optshape", terminal_width=100)
    if result.exit_code:
        raise ValueError(f"no help of {command}: {result.output}")
    return result.output
