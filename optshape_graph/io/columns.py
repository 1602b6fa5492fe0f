"""What a cloud's file holds before it is understood: named columns."""

from __future__ import annotations

import io
import itertools
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Value
from optshape_graph.errors import InputError


@dataclass(frozen=True, eq=False, repr=False)
class Columns(Value):
    """Named columns of a cloud, as recorded.

    Attributes:
        values: each (N,) or (N, k), of whatever type and unit the source has.
        height: rows of an organised cloud, stored row by row; 1: not organised.
        name: the source, for messages.
    """

    values: dict[str, NDArray[Any]]
    height: int = 1
    name: str = "cloud"


def parse_table(
    path: str | Path,
    body: bytes | memoryview,
    dtype: np.dtype[Any],
    rows: int | None = None,
    delimiter: str | None = None,
    usecols: Sequence[int] | None = None,
    first_line: int = 1,
) -> NDArray[Any]:
    """Return a table of numbers as a structured array (N,), in the units of the source.

    Args:
        path: the source, for messages.
        body: text, one point per line; blank lines do not count.
        dtype: structured type of one line.
        rows: how many points there must be; None: as many as there are.
        delimiter: between numbers; None: white space.
        usecols: the columns to read; None: all.
        first_line: where `body` starts in the file, for messages.

    Raises:
        InputError: a value that is not a number of the stated type, or another number of values or lines.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*input contained no data")
        try:
            table = np.loadtxt(io.BytesIO(body), dtype, None, delimiter, usecols=usecols, ndmin=1, encoding="latin-1")
        except (ValueError, OverflowError) as error:
            raise InputError(f"{path}:{_what_is_wrong(str(error), bytes(body), first_line)}") from error
    if rows is not None and len(table) != rows:
        raise InputError(f"{path}: the header promises {rows} points, {len(table)} lines of points follow it")
    return table


def _what_is_wrong(complaint: str, body: bytes, first_line: int) -> str:
    """Line, problem and column out of NumPy's complaint, which counts the lines of points from 0."""
    complaint = complaint.replace("the dtype passed requires", "expected")
    found = re.search(r"at row (\d+)(?:, column (\d+))?[^']*\Z", complaint)
    if found is None:
        return f" {complaint}"
    problem = complaint[: found.start()].rstrip(" ,")
    lines = (line for line, text in enumerate(body.splitlines(), first_line) if text.strip())
    line = next(itertools.islice(lines, int(found[1]), None), first_line)
    return f"{line}: {problem}" + (f" in column {found[2]}" if found[2] else "")
