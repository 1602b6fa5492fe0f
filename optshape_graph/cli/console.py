"""What every command prints with: tables on standard output, progress on standard error."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_FILE_WIDTH = 160
"""Columns of a table that goes to a file or a pipe."""


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], note: str = "") -> None:
    """Print a table: the first column flush left, the others right.

    Args:
        title: above it.
        columns: their headings, with units.
        rows: cells.
        note: below it.
    """
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    table = Table(
        title=title, title_justify="left", title_style="bold", caption=note or None, caption_justify="left",
        box=SIMPLE, padding=0,
    )  # fmt: skip
    for k, column in enumerate(columns):
        table.add_column(column, justify="right" if k else "left", overflow="fold", no_wrap=bool(k))
    for row in rows:
        table.add_row(*row)
    console = Console(markup=False, highlight=False)
    if not console.is_terminal:
        console.width = _FILE_WIDTH
    console.print(table)


def print_transform(name: str, meaning: str, T: NDArray[np.float64], covariance: NDArray[np.float64]) -> None:
    """Print a rigid transform and its standard deviations.

    Args:
        name: T_a_b.
        meaning: which points it maps where.
        T: (4, 4).
        covariance: (6, 6) of its right perturbation, rotation first.
    """
    import numpy as np

    sd = np.sqrt(np.diag(covariance))
    lines = ["  ".join(f"{value:10.6f}" for value in row) for row in T]
    rotation, translation = (" ".join(f"{value:.3g}" for value in part) for part in (np.degrees(sd[:3]), 1e3 * sd[3:]))
    click.echo(f"{name}: {meaning}")
    click.echo("\n".join(lines))
    click.echo(f"  sd: rotation {rotation} deg, translation {translation} mm\n")


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on standard error while the block runs, if that is a terminal.

    Yields:
        A function to call with how much is done, and of how much.
    """
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)
