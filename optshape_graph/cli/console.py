"""What every command prints with: tables on standard output, progress on standard error."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

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


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on standard error while the block runs, if that is a terminal.

    Yields:
        A function to call with how much is done, and of how much.
    """
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(what, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)
