"""Scans as a command line names them: files, folders, patterns, and lists of files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING

import click

from optshape_graph.cli.console import warn

if TYPE_CHECKING:
    from optshape_graph.sensor import SensorModel

ENDINGS = (".pcd", ".ply", ".npz", ".npy", ".bin", ".las", ".laz", ".e57")
"""Endings of clouds in a folder. A CSV may be anything: it is named by itself, or by a pattern."""

MOST_SCANS = 10_000_000


def scan_paths(words: tuple[str, ...]) -> list[str]:
    """Return the files that words name, in the order of the words; numbers in names sort as numbers.

    Args:
        words: each a file; a folder, for the clouds in it; a pattern such as `drive/*.pcd`; or `@list`, for the files
            that a text file names, one a line, relative to its own folder.

    Raises:
        click.UsageError: a word that names nothing, or too many files.
    """
    found: list[str] = []
    for word in words:
        found += _files(word)
        if len(found) > MOST_SCANS:
            raise click.UsageError(f"more than {MOST_SCANS} scans")
    return found


def sensor_of(name: str | None, paths: Sequence[str], columns: Sequence[str] | None) -> SensorModel | None:
    """Return the sensor of a name; without a name guess it from the clouds, and print the guess.

    Args:
        name: built-in, or a file; "none": there is none; None: it is guessed from the first, the middle and the last
            cloud. Guesses must agree.
        paths: the clouds.
        columns: names of their columns, if given.

    Raises:
        InputError: no such sensor.
    """
    from optshape_graph.errors import InputError, MissingExtraError
    from optshape_graph.io import load_sensor, read_scan
    from optshape_graph.io.sensor_guess import guess_sensor

    if name is not None:
        return None if name == "none" else load_sensor(name)
    guesses = []
    for path in dict.fromkeys([paths[0], paths[len(paths) // 2], paths[-1]]):
        with suppress(InputError, MissingExtraError):  # reported when it is its turn
            guesses.append(guess_sensor(read_scan(path, None, columns)))
    told = {guess.sensor.name: guess.sensor for guess in guesses if guess.sensor is not None}
    if len(told) != 1:
        return None
    ((found, sensor),) = told.items()
    if any(found not in guess.misfits for guess in guesses):
        return None
    warn(f"sensor: {found}, whose table the elevations fit (--sensor none: without)")
    return sensor


def by_number(name: str) -> list[str | int]:
    """Return a key that sorts names as people count: scan_2 before scan_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", name)]


def _files(word: str) -> list[str]:
    path = Path(word)
    if word.startswith("@"):
        return _listed(Path(word[1:]))
    if _is_folder(path):
        inside = [str(one) for one in path.iterdir() if one.suffix.lower() in ENDINGS and not one.name.startswith(".")]
        if not inside:
            raise click.UsageError(f"{word}: no clouds in the folder ({', '.join(ENDINGS)})")
        return sorted(inside, key=by_number)
    if re.search(r"[*?[]", word) and not path.exists():
        matching = sorted(glob(word), key=by_number)
        if not matching:
            raise click.UsageError(f"{word}: no file matches")
        return matching
    return [word]


def _listed(path: Path) -> list[str]:
    from optshape_graph.io.files import read_text

    lines = [line.strip() for line in read_text(path).splitlines()]
    named = [str(path.parent / line) for line in lines if line and not line.startswith("#")]
    if not named:
        raise click.UsageError(f"@{path}: the list names no files")
    return named


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False
