"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click


def outside_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--allow-outside` to a command that reads sessions; it takes the value as `allow_outside`."""
    return click.option(
        "--allow-outside", is_flag=True,
        help="Follow relative paths of a session, and links, farther than into its folder and the one above.",
    )(function)  # fmt: skip
