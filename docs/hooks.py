"""What pages take from the package itself when the documentation is built: the commands with their help."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import click

COMMANDS = "<!-- commands -->\n"
"""The line that all commands replace."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put what the package says in place of the mark."""
    if COMMANDS not in markdown:
        return markdown
    from optshape_graph.cli.main import cli

    root = click.Context(cli, info_name="optshape", terminal_width=100)
    return markdown.replace(COMMANDS, "\n".join(sections(root, "")))


def sections(context: click.Context, name: str) -> Iterator[str]:
    """Yield a section for a command, and for those in it if it is a group."""
    group = context.command
    if not isinstance(group, click.Group) or not name:
        yield f"## {name or 'optshape'}\n\n```text\n{context.get_help()}\n```\n"
    if isinstance(group, click.Group):
        for word in group.list_commands(context):
            command = group.get_command(context, word)
            assert command is not None
            inner = click.Context(command, parent=context, info_name=word, terminal_width=100)
            yield from sections(inner, f"{name} {word}".strip())
