"""Tables of text, as the vendors of motion capture export them: cells, gaps and header entries."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.io.files import read_bytes

Rows = list[list[str]]
"""The cells of a table, row by row, without blanks around them."""


def read_text(path: Path) -> str:
    """Return the text of an export. It is UTF-8; a Windows program may have written names in another code page.

    Raises:
        InputError: a file that is not readable.
    """
    return read_bytes(path).decode("utf-8-sig", errors="replace")


def read_table(path: Path, delimiter: str) -> Rows:
    """Return the rows of a table.

    Raises:
        InputError: a file that is not readable, not CSV, or empty.
    """
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(read_text(path).splitlines(), delimiter=delimiter)]
    except csv.Error as error:
        raise InputError(f"{path}: {error}") from error
    if not any(any(row) for row in rows):
        raise InputError(f"{path}: the file is empty")
    return rows


def positions_of(rows: Rows, columns: Sequence[int], metres: float) -> Floats:
    """Return the positions (F, M, 3), in metres, in 3 M columns of the frames' rows; NaN where a cell has no number.

    Args:
        rows: of the F frames.
        columns: x, y and z of each marker in turn.
        metres: in the file's unit of length.
    """
    return numbers_in(rows, columns).reshape(len(rows), len(columns) // 3, 3) * metres


def numbers_in(rows: Rows, columns: Sequence[int]) -> Floats:
    """Return the numbers (F, C) in C columns of F rows; NaN where a row ends before, or a cell has no number."""
    values = [[_number(row[k]) if k < len(row) else np.nan for k in columns] for row in rows]
    return np.array(values, dtype=float).reshape(len(rows), len(columns))


def column_of(rows: Rows, column: int, path: Path) -> Floats:
    """Return the numbers (F,) in a column that has one in every frame.

    Raises:
        InputError: a frame without a number there; the message names the file.
    """
    values = numbers_in(rows, [column])[:, 0]
    if np.isnan(values).any():
        k = int(np.isnan(values).argmax())
        raise InputError(f"{path}: frame {k} has no number in column {column + 1}, found {rows[k][: column + 1]}")
    return values


def _number(cell: str) -> float:
    """Return the number in a cell, or NaN: vendors write a gap as an empty cell or as a word."""
    try:
        return float(cell)
    except ValueError:
        return np.nan


def is_number(cell: str) -> bool:
    """Return whether a cell has a number in it."""
    return not np.isnan(_number(cell))


def header_number(header: dict[str, list[str]], key: str, path: Path) -> float:
    """Return the number that a header states.

    Raises:
        InputError: no such key, or no number; the message names the file.
    """
    value = (header.get(key) or ["(none)"])[0]
    if not is_number(value):
        raise InputError(f"{path}: expected a number as {key} in the header, found {value}")
    return float(value)
