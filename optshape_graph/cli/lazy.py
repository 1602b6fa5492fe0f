"""Groups of commands that are imported when they are run, so that help imports none of them."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import click


class LazyGroup(click.Group):
    """A group that imports a command when it is run.

    Args:
        commands_at: for each command the module that defines it, as `command`.
        help_of: one line of help for each.
    """

    def __init__(self, *args: Any, commands_at: Mapping[str, str], help_of: Mapping[str, str], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.commands_at, self.help_of = commands_at, help_of

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands_at)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self.commands_at:
            return None
        command: click.Command = importlib.import_module(self.commands_at[cmd_name]).command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(self.help_of.items()))
