"""NPZ files: named NumPy arrays, never pickled ones."""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph.errors import InputError
from optshape_graph.io.columns import Columns
from optshape_graph.io.files import LARGEST_FILE, read_bytes

LARGEST_RATIO = 50
"""Bytes that a compressed one may become, beyond `SMALL` in all: noise hardly compresses, and every scan has noise."""

SMALL = 64 << 20

_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    RuntimeError,  # of zipfile: encrypted, or compressed in a way that it does not know
    ValueError,
    TypeError,
    SyntaxError,
    tokenize.TokenError,  # of a header that NumPy takes for one written by Python 2
    OverflowError,
)
"""What zipfile and NumPy raise for an archive or a header that is not what it should be."""


def read_npz(path: str | Path) -> Columns:
    """Return the arrays of an NPZ file.

    Raises:
        InputError: not readable, not an NPZ file, arrays of Python objects (which would have to be unpickled), or an
            array whose header does not fit its data.
    """
    data = read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [info for info in archive.infolist() if info.filename.endswith(".npy")]
            claimed = sum(info.file_size for info in members)
            if claimed > LARGEST_FILE or claimed > SMALL + LARGEST_RATIO * len(data):
                raise InputError(f"{path}: its arrays claim {claimed} bytes, out of {len(data)} compressed ones")
            arrays = {info.filename.removesuffix(".npy"): _read_array(path, archive, info) for info in members}
    except InputError:
        raise
    except _DAMAGE as error:
        raise InputError(f"{path}: not a usable NPZ file: {error}") from error
    return Columns(arrays, name=str(path))


def _read_array(path: str | Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """Read one array, after comparing what its header promises with the bytes that are there."""
    name = info.filename
    with archive.open(info) as stream:
        content = stream.read()
    header = io.BytesIO(content)
    version = np.lib.format.read_magic(header)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(header)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(header)
    if dtype.hasobject:
        raise InputError(f"{path}: array '{name}' holds Python objects; expected numbers")
    promised, there = math.prod(shape) * dtype.itemsize, len(content) - header.tell()
    if promised != there:
        raise InputError(f"{path}: array '{name}' promises {promised} bytes of data, {there} are there")
    header.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(header, allow_pickle=False)
    return array
