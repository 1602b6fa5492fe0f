"""Printing for every command: tables on standard output, progress on standard error."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from optshape_graph.names import shown

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from optshape_graph.io.passed_over import PassedOver

_FILE_WIDTH = 160
"""Columns of a table that goes to a file or a pipe."""

_PLAIN = str.maketrans({"±": "+-", "°": " deg", "∞": "inf", "…": "...", "·": "*", "²": "2", "μ": "u", "→": "->"})
"""Text for signs that a terminal without Unicode lacks."""

TABLES_ASIDE = "optshape.tables_aside"
"""What a click context knows where standard output is taken by JSON: tables and lines go to standard error."""

SECONDS_BETWEEN = 60.0
"""Seconds between two lines of progress, if standard error is no terminal."""


def say(text: object, *, err: bool = False) -> None:
    """Print one line; control characters are escaped, and signs that the terminal lacks are spelled out.

    Args:
        text: the line, which may have names from data in it.
        err: print to standard error.
    """
    err = err or _aside()
    click.echo(_for(sys.stderr if err else sys.stdout, shown(text)), err=err)


def _aside() -> bool:
    context = click.get_current_context(silent=True)
    return context is not None and TABLES_ASIDE in context.meta


def warn(text: object) -> None:
    """Print one line to standard error, with the name of this program before it."""
    say(f"optshape: {text}", err=True)


def _for(stream: object, text: str) -> str:
    encoding = getattr(stream, "encoding", None) or "ascii"
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return text.translate(_PLAIN).encode(encoding, "backslashreplace").decode(encoding)
    except LookupError:
        return text.translate(_PLAIN).encode("ascii", "backslashreplace").decode()
    return text


def print_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], note: str = "", *, err: bool = False
) -> None:
    """Print a table: the first column flush left, the others right.

    Args:
        title: above it.
        columns: their headings, with units.
        rows: cells.
        note: below it.
        err: print to standard error.
    """
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    err = err or _aside()

    def cell(text: str) -> str:
        return _for(sys.stderr if err else sys.stdout, shown(text))

    table = Table(
        title=cell(title), title_justify="left", title_style="bold", caption=cell(note) if note else None,
        caption_justify="left", box=SIMPLE, padding=0,
    )  # fmt: skip
    for k, column in enumerate(columns):
        table.add_column(cell(column), justify="right" if k else "left", overflow="fold", no_wrap=bool(k))
    for row in rows:
        table.add_row(*map(cell, row))
    console = Console(markup=False, emoji=False, highlight=False, stderr=err)
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
    say(f"{name}: {meaning}")
    for line in lines:
        say(line)
    say(f"  sd: rotation {rotation} deg, translation {translation} mm")
    say("")


def terminal() -> bool:
    """Return whether standard error is a terminal that can move its cursor."""
    return sys.stderr.isatty() and os.environ.get("TERM") != "dumb"


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show the progress and speed of the block on standard error: a bar on a terminal, else a line a minute.

    Args:
        what: the name of the work.

    Yields:
        A function to call with the number of finished steps, and of all steps.
    """
    if not terminal():
        yield _lines_of_progress(what)
        return
    from rich.console import Console
    from rich.progress import Progress, TextColumn

    console, begun = Console(stderr=True), time.monotonic()
    with Progress(
        *Progress.get_default_columns(), TextColumn("{task.fields[speed]}"), console=console, transient=True
    ) as progress:
        task = progress.add_task(what, total=None, speed="")
        yield lambda done, total: progress.update(
            task, completed=done, total=total, speed=_speed(done, time.monotonic() - begun)
        )


def _speed(done: int, seconds: float) -> str:
    """Return how many steps are done in a second, or how long each takes if that is more than a second."""
    if not done or seconds <= 0:
        return ""
    return f"{done / seconds:.1f}/s" if done >= seconds else f"{seconds / done:.1f} s each"


def _lines_of_progress(what: str) -> Callable[[int, int], None]:
    begun = said = time.monotonic()

    def report(done: int, total: int) -> None:
        nonlocal said
        now = time.monotonic()
        if now - said >= SECONDS_BETWEEN:
            said = now
            speed = _speed(done, now - begun)
            warn(f"{what}: {done} of {total} after {(now - begun) / 60:.0f} min" + (f", {speed}" if speed else ""))

    return report


def say_passed_over(passed_over: PassedOver) -> None:
    """Print which input was not used, a line for each reason."""
    for line in passed_over.lines():
        say(f"  {line}")
