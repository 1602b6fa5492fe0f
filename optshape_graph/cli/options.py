"""Options that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from optshape_graph.cli.console import TABLES_ASIDE
from optshape_graph.runs.workers import Pool

MOST_WORKERS = 1024
MOST_SEED = 2**63 - 1
"""Largest seed: every program reads it from JSON unchanged."""


class File(click.Path):
    """A file by its name; `-` is none, but where JSON is written: standard output, and tables go to standard error.

    Args:
        standard_output: whether `-` means that.
    """

    def __init__(self, standard_output: bool = False) -> None:
        super().__init__(dir_okay=False, path_type=Path)
        self.standard_output = standard_output

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the file's path."""
        if str(value) != "-":
            return super().convert(value, param, ctx)
        if not self.standard_output or ctx is None:
            self.fail("expected the name of a file, found '-'", param, ctx)
        ctx.meta[TABLES_ASIDE] = True
        return Path("/dev/stdout")


FILE = File()
JSON_FILE = File(standard_output=True)


class Folder(click.Path):
    """A folder by its name; an empty name, as from an unset variable of the shell, is an error."""

    def __init__(self) -> None:
        super().__init__(file_okay=False, path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the folder's path."""
        if value == "":
            self.fail("expected the name of a folder, found ''", param, ctx)
        return super().convert(value, param, ctx)


FOLDER = Folder()


class Number(click.ParamType):  # type: ignore[type-arg]  # generic in newer versions of click only
    """A finite number within a range, which the error message states.

    Args:
        least: the number is at least this.
        most: it is at most this.
        open: leave out the least itself.
        finite: refuse infinity.
    """

    name = "number"

    def __init__(
        self, least: float = -math.inf, most: float = math.inf, *, open: bool = False, finite: bool = True
    ) -> None:
        self.least, self.most, self.open, self.finite = least, most, open, finite

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number that a text is."""
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        above = number > self.least if self.open else number >= self.least
        if not (above and number <= self.most and (math.isfinite(number) or not self.finite)):
            self.fail(f"expected a number {self._range()}, found '{value}'", param, ctx)
        return number

    def _range(self) -> str:
        least = f"{'above' if self.open else 'of at least'} {self.least:g}" if math.isfinite(self.least) else ""
        most = f"of at most {self.most:g}" if math.isfinite(self.most) else ""
        return " and ".join(filter(None, [least, most])) or "that is finite"


POSITIVE = Number(0.0, open=True)
DISTANCE = Number(0.0, 1000.0, open=True)
"""Distance of a target from the sensor, metres."""
ANGLE = Number(-360.0, 360.0)
"""Degrees."""
PAPER = click.Choice(["A0", "A1", "A2", "A3", "A4"], case_sensitive=False)
"""Size of a sheet."""


def example(*lines: str) -> str:
    """Return the epilog of a command's help: an example to copy."""
    return "\b\nExample:\n" + "\n".join(f"  {line}" for line in lines)


def outside_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--allow-outside` to a command that reads sessions; it takes the value as `allow_outside`."""
    return click.option(
        "--allow-outside", is_flag=True,
        help="Follow relative paths of a session, and links, farther than into its folder and the one above.",
    )(function)  # fmt: skip


def sensor_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--sensor` to a command that reads clouds; it takes the value as `sensor`, for `inputs.sensor_of`."""
    return click.option(
        "--sensor",
        help="Built-in name, sensor file, or a maker's file of the unit's beams; `none`: rings from the cloud, noise "
        "of a centimetre.  [default: the built-in one whose table the elevations fit, which is said; or `none`]",
    )(function)


def columns_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--columns` to a command that reads clouds; it takes the names as `columns`, or None."""
    return click.option(
        "--columns", metavar="NAMES", callback=lambda _ctx, _param, value: value and tuple(value.split(",")),
        help="Names of the columns of clouds that do not name them (CSV, .bin, .npy): x,y,z,_,ring.",
    )(function)  # fmt: skip


def journal_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--json FILE` to a command over many scans; it takes the value as `json_path`."""
    return click.option(
        "--json", "json_path", type=JSON_FILE, help="Write the results to this file (- is standard output); until it "
        "is whole they are kept in FILE.journal, from which a rerun goes on.",
    )(function)  # fmt: skip


def force_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--force` to a command that writes files; it takes the value as `force`."""
    return click.option("--force", is_flag=True, help="Replace existing files, but never inputs.")(function)


def pool_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--workers`, `--dask` and `--dask-tls`; the command takes the pool that they describe as `pool`, or None."""

    @wraps(function)
    def with_pool(*args: Any, workers: int | None, dask: str | None, dask_tls: Any, **kwargs: Any) -> Any:
        if dask is None and dask_tls is not None:
            raise click.UsageError("--dask-tls goes with --dask")
        if dask is not None and workers is not None:
            raise click.UsageError("give either --workers or --dask")
        pool = None if workers is None and dask is None else Pool(workers or 1, dask, dask_tls)
        return function(*args, pool=pool, **kwargs)

    for option in (
        click.option("--dask-tls", nargs=3, type=click.Path(exists=True, dir_okay=False, path_type=Path),
                     metavar="CA CERT KEY", help="Files (PEM) for TLS with it: authority, certificate, key."),
        click.option("--dask", metavar="ADDRESS", help="Use the workers of this Dask scheduler instead."),
        click.option("--workers", type=click.IntRange(1, MOST_WORKERS), help="Processes on this machine."),
    ):  # fmt: skip
        option(with_pool)
    return with_pool


def seed_option(what: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the decorator that adds `--seed`.

    Args:
        what: the help: what is drawn from it.
    """
    return click.option("--seed", type=click.IntRange(0, MOST_SEED), default=0, show_default=True, help=what)
