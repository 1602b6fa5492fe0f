"""PLY files (Stanford polygon format): ascii and binary of both byte orders; the scalar properties of the vertices.

This package has its own reader, since `plyfile` is under the GPL, and Open3D is heavy.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.clouds.columns import Columns
from optshape_graph.io.clouds.text import parse_table
from optshape_graph.io.files import read_bytes

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "bool": "u1", "boolean": "u1", "int64": "i8", "long": "i8", "uint64": "u8",
    "ulong": "u8",
}  # fmt: skip
_FORMATS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_LARGEST_HEADER = 1 << 16


def read_ply(path: str | Path) -> Columns:
    """Return the properties of a PLY file's vertices, with the types that its header states.

    Raises:
        InputError: not readable, not a PLY file, a list among the vertices' properties, other elements before the
            vertices, or a header that does not fit the data.
    """
    data = read_bytes(path)
    form, count, dtype, start = _read_header(path, data)
    body = memoryview(data)[start:]
    if form == "ascii":
        # Lines after the vertices belong to other elements (faces), which have another number of columns.
        lines = bytes(body).splitlines()
        first = data[:start].count(b"\n") + 1
        table = parse_table(path, b"\n".join(lines[:count]), dtype, count, first_line=first)
    else:
        if len(body) < count * dtype.itemsize:
            _fail(
                path,
                f"the header promises {count} vertices of {dtype.itemsize} bytes, {count * dtype.itemsize} in all; "
                f"{len(body)} bytes follow it",
            )
        table = np.frombuffer(body, dtype, count)
    return Columns({name: table[name] for name in dtype.names or ()}, name=str(path))


def _fail(path: str | Path, problem: str) -> NoReturn:
    raise InputError(f"{path}: not a usable PLY file: {problem}")


def _read_header(path: str | Path, data: bytes) -> tuple[str, int, np.dtype[Any], int]:
    """Return format, number of vertices, type of one vertex, and the byte at which the data start."""
    stream = io.BytesIO(data[:_LARGEST_HEADER])
    if stream.readline().strip() != b"ply":
        _fail(path, "its first line is not 'ply'")
    form, count, element = "", -1, ""
    properties: list[tuple[str, str]] = []
    for raw in stream:
        words = raw.decode("latin-1").split()
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, _] if name in _FORMATS:
                form = name
            case ["element", name, number] if number.isdecimal() and len(number) <= 18:
                element = name
                if name == "vertex":
                    count = int(number)
                elif count < 0 and int(number) > 0:
                    _fail(path, f"element '{name}' comes before the vertices; expected the vertices first")
            case ["property", kind, name] if kind in _TYPES:
                if element == "vertex":
                    properties.append((name, _TYPES[kind]))
            case ["property", "list", *_]:
                if element == "vertex":
                    _fail(path, f"the vertices have a list ({' '.join(words)}); expected plain numbers")
            case ["end_header"]:
                break
            case _:
                _fail(path, f"its header has a line that is not understood: {' '.join(words)[:60]!r}")
    else:
        _fail(path, "its header has no line 'end_header'")
    if not form:
        _fail(path, f"its header has no line 'format ...', of {', '.join(_FORMATS)}")
    if count < 0 or not properties:
        _fail(path, "its header declares no vertices")
    if len({name for name, _ in properties}) < len(properties):
        _fail(path, f"a property is named twice: {' '.join(name for name, _ in properties)}")
    return form, count, np.dtype([(name, _FORMATS[form] + kind) for name, kind in properties]), stream.tell()
