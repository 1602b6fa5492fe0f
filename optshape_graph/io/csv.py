"""CSV clouds: a first line that names the columns, then one return per line."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.columns import Columns, parse_table
from optshape_graph.io.files import read_text

_DELIMITERS = (",", ";", "\t")


def read_csv(path: str | Path, wanted: Collection[str]) -> Columns:
    """Return the columns of a CSV file that have one of the `wanted` names (lower case), whatever their case.

    Columns are separated by commas, semicolons, tabs or blanks; other columns may hold anything.

    Raises:
        InputError: not readable, no line of names, or a value in one of those columns that is not a number.
    """
    text = read_text(path)
    first, _, body = text.lstrip("\r\n").partition("\n")
    delimiter = next((d for d in _DELIMITERS if d in first), None)
    names = [name.strip().strip('"').strip() for name in first.lstrip("#/ ").strip().split(delimiter)]
    columns = {i: name for i, name in enumerate(names) if name.lower() in wanted}
    if not columns:
        raise InputError(f"{path}: expected a first line that names the columns, as x,y,z,ring; found {first[:80]!r}")
    if len(set(columns.values())) < len(columns):
        raise InputError(f"{path}: a column is named twice: {', '.join(columns.values())}")
    dtype = np.dtype([(name, "f8") for name in columns.values()])
    table = parse_table(path, body.encode(), dtype, delimiter=delimiter, usecols=list(columns), first_line=2)
    return Columns({name: table[name] for name in columns.values()}, name=str(path))
