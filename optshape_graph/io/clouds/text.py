"""Clouds as text: one return per line, after a line that names the columns, or with names that are given."""

from __future__ import annotations

import io
import itertools
import logging
import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph.errors import InputError
from optshape_graph.io.clouds.columns import Columns, roles
from optshape_graph.io.files import read_bytes

_LOG = logging.getLogger(__name__)

LARGEST_BAD_SHARE = 0.1
"""Share of lines that may be bad; they are left out and counted."""

_DELIMITERS = (",", ";", "\t")
_COMMENTS = ("#", "//", "%")
_PREAMBLE = 50
"""The line that names the columns is among so many first lines."""

_SKIPPED = ("", "_", "-", "*")
"""Names that the caller gives to columns to be skipped."""


def read_table(path: str | Path, wanted: Callable[[Sequence[str]], Sequence[str]], expected: str) -> Columns:
    """Return columns of a text file whose first line names them.

    Commas, semicolons, tabs or blanks separate columns; columns that are not wanted may hold anything. Lines before the
    one that names the columns, and comments, are skipped.

    Args:
        path: the file.
        wanted: picks the names to read out of all names.
        expected: what the first line should look like, for messages.

    Raises:
        InputError: not readable, no line of wanted names, or too many lines that are not numbers.
    """
    lines = decode(read_bytes(path)).splitlines()
    shown = next((line.strip() for line in lines if line.strip()), "")
    for number, line in enumerate(lines[:_PREAMBLE]):
        if not line.strip():
            continue
        delimiter = _delimiter(line)
        names = [name.strip().strip('"').strip() for name in _uncommented(line).split(delimiter)]
        if all(map(_is_number, names)):
            break
        if chosen := list(wanted(names)):
            if repeated := [name for name in chosen if names.count(name) > 1]:
                raise InputError(f"{path}: a column is named twice: {', '.join([n for n in names if n in repeated])}")
            return _numbers(path, lines[number + 1 :], names, chosen, delimiter, number + 2)
    raise InputError(f"{path}: expected a first line that names the columns, as {expected}; found {shown[:80]!r}")


def read_csv(path: str | Path, names: Sequence[str] | None = None) -> Columns:
    """Return the columns with known names (`columns.KNOWN`) of a cloud's text file.

    Args:
        path: the file.
        names: of its columns, in order, for a file without names or with others; "_" skips one. None: the file's own.

    Raises:
        InputError: as `read_table`, or no names for x, y and z.
    """
    if names is not None:
        return _with_names(path, names)

    def known(found: Sequence[str]) -> Sequence[str]:
        try:
            there = roles(found)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        return [role.column for role in there.values()] if "xyz" in there or {"x", "y", "z"} <= there.keys() else []

    try:
        return read_table(path, known, "x,y,z,ring")
    except InputError as error:
        if "expected a first line that names" not in str(error):
            raise
        raise InputError(f"{error}; name the columns of a file without such a line: --columns x,y,z,_,ring") from error


def _with_names(path: str | Path, names: Sequence[str]) -> Columns:
    """Return the columns of a file by given names; lines before the first line of numbers are skipped."""
    lines = decode(read_bytes(path)).splitlines()
    chosen = [name for name in names if name.strip() not in _SKIPPED]
    there = roles(chosen)
    if not ("xyz" in there or {"x", "y", "z"} <= there.keys()):
        raise InputError(f"{path}: expected x, y and z among the names given; found: {', '.join(names)}")
    if len(set(chosen)) < len(chosen):
        raise InputError(f"{path}: a column is named twice: {', '.join(names)}")
    for number, line in enumerate(lines):
        delimiter = _delimiter(line)
        cells = line.split(delimiter)
        if line.strip() and not line.lstrip().startswith(_COMMENTS) and all(map(_is_number, cells)):
            if len(cells) < len(names):
                raise InputError(f"{path}:{number + 1}: {len(names)} columns are named, found {len(cells)} values")
            return _numbers(path, lines[number:], list(names), chosen, delimiter, number + 1)
    raise InputError(f"{path}: no line of numbers")


def decode(data: bytes) -> str:
    """Return the text of a file that another program wrote: UTF-8, UTF-16 with its mark, or Latin-1."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def parse_table(
    path: str | Path,
    body: bytes | memoryview,
    dtype: np.dtype[Any],
    rows: int | None = None,
    first_line: int = 1,
) -> NDArray[Any]:
    """Return a table of numbers that white space separates as a structured array (N,).

    Args:
        path: the source, for messages.
        body: text, one point per line; blank lines do not count.
        dtype: structured type of one line. Integers may be written as floats ("3.0").
        rows: how many points there must be; None: any number.
        first_line: where `body` starts in the file, for messages.

    Raises:
        InputError: a value that is not a number of the stated type, or another number of values or lines.
    """
    try:
        table = _load(body, dtype, None)
    except (ValueError, OverflowError) as error:
        read = _integers_as_floats(body, dtype)
        if read is None:
            raise InputError(f"{path}:{_what_is_wrong(str(error), bytes(body), first_line)}") from error
        table = read
    if rows is not None and len(table) != rows:
        raise InputError(f"{path}: the header promises {rows} points, {len(table)} lines of points follow it")
    return table


def _load(
    body: bytes | memoryview, dtype: np.dtype[Any], delimiter: str | None, usecols: Sequence[int] | None = None
) -> NDArray[Any]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*input contained no data")
        return np.loadtxt(io.BytesIO(body), dtype, None, delimiter, usecols=usecols, ndmin=1, encoding="latin-1")


def _integers_as_floats(body: bytes | memoryview, dtype: np.dtype[Any]) -> NDArray[Any] | None:
    """Return the table with its integers read as floats; None: it cannot be read so either."""
    floating = np.dtype([(name, "f8", dtype[name].shape) for name in dtype.names or ()])
    try:
        table = _load(body, floating, None)
    except (ValueError, OverflowError):
        return None
    for name in dtype.names or ():
        if dtype[name].base.kind in "iu":
            limits = np.iinfo(dtype[name].base)
            if not ((table[name] >= limits.min) & (table[name] <= limits.max) & (table[name] % 1 == 0)).all():
                return None
    return table.astype(dtype)


def _numbers(
    path: str | Path, lines: list[str], names: list[str], chosen: list[str], delimiter: str | None, first_line: int
) -> Columns:
    """Return the chosen columns of lines of numbers."""
    if delimiter in (";", "\t") and any("," in line for line in lines):
        lines = [line.replace(",", ".") for line in lines]  # decimal commas
    if any(line.lstrip().startswith(_COMMENTS) for line in lines):
        lines = ["" if line.lstrip().startswith(_COMMENTS) else line for line in lines]
    indices = [names.index(name) for name in chosen]
    dtype = np.dtype([(name, "f8") for name in chosen])
    body = "\n".join(lines).encode()
    try:
        table = _load(body, dtype, delimiter, indices)
    except (ValueError, OverflowError) as error:
        table = _good_lines(path, lines, dtype, delimiter, indices, str(error), first_line)
    return Columns({name: table[name] for name in chosen}, name=str(path))


def _good_lines(
    path: str | Path,
    lines: list[str],
    dtype: np.dtype[Any],
    delimiter: str | None,
    indices: list[int],
    complaint: str,
    first_line: int,
) -> NDArray[Any]:
    """Return the lines that consist of numbers, where a few do not."""
    rows: list[tuple[float, ...]] = []
    bad, first = 0, 0
    for number, line in enumerate(lines, first_line):
        if not line.strip():
            continue
        cells = line.split(delimiter)
        try:
            rows.append(tuple(float(cells[k].strip().strip('"') or "nan") for k in indices))
        except (ValueError, IndexError):
            bad += 1
            first = first or number
    if bad > LARGEST_BAD_SHARE * (len(rows) + bad):
        raise InputError(f"{path}:{_what_is_wrong(complaint, chr(10).join(lines).encode(), first_line)}")
    if bad:
        _LOG.warning("%s: %d of %d lines are no returns and left out, the first on line %d", path, bad,
                     len(rows) + bad, first)  # fmt: skip
    return np.array(rows, dtype)


def _delimiter(line: str) -> str | None:
    return next((d for d in _DELIMITERS if d in line), None)


def _uncommented(line: str) -> str:
    return re.sub(r"\A\s*(#+|/{2,}|%+)?\s*", "", line)


def _is_number(word: str) -> bool:
    try:
        float(word.strip().replace(",", "."))
    except ValueError:
        return False
    return True


def _what_is_wrong(complaint: str, body: bytes, first_line: int) -> str:
    """Return line, problem and column from NumPy's complaint, which counts lines of points from 0."""
    complaint = complaint.replace("the dtype passed requires", "expected")
    found = re.search(r"at row (\d+)(?:, column (\d+))?[^']*\Z", complaint)
    if found is None:
        return f" {complaint}"
    problem = complaint[: found.start()].rstrip(" ,")
    lines = (line for line, text in enumerate(body.splitlines(), first_line) if text.strip())
    line = next(itertools.islice(lines, int(found[1]), None), first_line)
    return f"{line}: {problem}" + (f" in column {found[2]}" if found[2] else "")
