"""NPZ and NPY files: NumPy arrays, named or structured, never pickled."""

from __future__ import annotations

import io
import logging
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph.errors import InputError
from optshape_graph.io.clouds.columns import Columns, roles
from optshape_graph.io.files import LARGEST_FILE, read_bytes

_LOG = logging.getLogger(__name__)

WIDEST = 32
"""Columns that a table without names has at most."""

LARGEST_RATIO = 50
"""Bytes that a compressed byte may expand to, beyond `SMALL` in all: a scan has noise, which hardly compresses."""

SMALL = 64 << 20

_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    RuntimeError,  # from zipfile: encrypted, or an unknown compression
    ValueError,
    TypeError,
    SyntaxError,
    tokenize.TokenError,  # from a header that NumPy takes for one of Python 2
    OverflowError,
)
"""Exceptions of zipfile and NumPy for a damaged archive or header."""


def read_npz(path: str | Path) -> Columns:
    """Return the arrays of an NPZ file as columns; each field of a structured array is a column.

    Raises:
        InputError: not readable, not an NPZ file, points of Python objects (which would have to be unpickled), or an
            array whose header does not fit its data.
    """
    data = read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [info for info in archive.infolist() if info.filename.endswith(".npy")]
            claimed = sum(info.file_size for info in members)
            if claimed > LARGEST_FILE or claimed > SMALL + LARGEST_RATIO * len(data):
                raise InputError(f"{path}: its arrays claim {claimed} bytes, out of {len(data)} compressed ones")
            arrays = {
                info.filename.removesuffix(".npy"): _parse_array(path, info.filename, archive.read(info))
                for info in members
            }
    except InputError:
        raise
    except _DAMAGE as error:
        raise InputError(f"{path}: not a usable NPZ file: {error}") from error
    return _columns(path, {name: array for name, array in arrays.items() if array is not None}, None)


def read_npy(path: str | Path, names: Sequence[str] | None = None) -> Columns:
    """Return the columns of an NPY file: a structured array, or N x k numbers.

    Args:
        path: the file.
        names: of the k columns, in order; "_" skips one. None: the first three are x, y, z.

    Raises:
        InputError: not readable, not an NPY file, Python objects, or a header that does not fit the data.
    """
    try:
        array = _parse_array(path, "points", read_bytes(path))
    except InputError:
        raise
    except _DAMAGE as error:
        raise InputError(f"{path}: not a usable NPY file: {error}") from error
    assert array is not None  # points of objects are refused
    return _columns(path, {"points": array}, names)


def _columns(path: str | Path, arrays: dict[str, NDArray[Any]], names: Sequence[str] | None) -> Columns:
    """Return arrays as columns: structured arrays by their fields, and a table without names by the given ones."""
    columns: dict[str, NDArray[Any]] = {}
    height = 1
    for name, array in arrays.items():
        if array.dtype.names:
            columns |= {field: array[field].reshape(-1) for field in array.dtype.names if not array[field].dtype.names
                        and array[field].shape == array.shape}  # fmt: skip
            height = array.shape[0] if array.ndim == 2 else height
        else:
            columns[name] = array
            height = array.shape[0] if array.ndim == 3 and array.shape[2] == 3 else height
    known = roles(columns)
    if {"x", "y", "z"} <= known.keys():
        return Columns(columns, height, str(path))
    tables = [name for name, array in columns.items() if array.ndim == 2 and array.dtype.kind in "iuf"
              and 3 <= array.shape[1] <= WIDEST and array.shape[1] <= len(array)]  # fmt: skip
    table = known["xyz"].column if "xyz" in known else tables[0] if len(tables) == 1 else None
    if table in tables and (names is not None or columns[table].shape[1] > 3 or "xyz" not in known):
        values = columns.pop(table)
        if names is not None and len(names) > values.shape[1]:
            raise InputError(f"{path}: {len(names)} columns are named, found {values.shape[1]}")
        if names is None and values.shape[1] > 3:
            _LOG.warning("%s: the first three of %d unnamed columns are taken as x, y, z; --columns x,y,z,_,ring names "
                         "the others", path, values.shape[1])  # fmt: skip
        for k, name in enumerate(names if names is not None else "xyz"):
            if name not in ("", "_", "-"):
                columns[name] = values[:, k]
    return Columns(columns, height, str(path))


def _parse_array(path: str | Path, name: str, content: bytes) -> NDArray[Any] | None:
    """Parse one array, after its header was checked against the number of bytes.

    An array of Python objects under an unknown name is skipped: None.
    """
    header = io.BytesIO(content)
    version = np.lib.format.read_magic(header)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(header)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(header)
    if dtype.hasobject:
        if roles([name.removesuffix(".npy")]):
            raise InputError(f"{path}: array '{name}' holds Python objects; expected numbers")
        _LOG.warning("%s: array '%s' holds Python objects; it is passed over", path, name)
        return None
    promised, there = math.prod(shape) * dtype.itemsize, len(content) - header.tell()
    if promised != there:
        raise InputError(f"{path}: array '{name}' promises {promised} bytes of data, {there} are there")
    header.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(header, allow_pickle=False)
    return array
