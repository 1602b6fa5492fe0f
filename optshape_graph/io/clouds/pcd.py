"""PCD files (Point Cloud Library, version 0.7): ascii, binary and binary_compressed.

This package has its own reader, since others are heavy (Open3D), or trust the sizes in the header and lose fields of
unexpected types (pypcd4). Here every size is checked against the file's before memory is allocated.
"""

from __future__ import annotations

import io
import logging
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray

from optshape_graph.errors import InputError
from optshape_graph.io.clouds.columns import Columns
from optshape_graph.io.clouds.lzf import lzf_decompress
from optshape_graph.io.clouds.text import parse_table
from optshape_graph.io.files import open_bounded, write_atomically

_LOG = logging.getLogger(__name__)
_KEYS = ("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_TYPES = {(k, n): f"<{k.lower()}{n}" for k, sizes in (("F", "48"), ("I", "1248"), ("U", "1248")) for n in sizes}
_NO_VIEWPOINT = ["0", "0", "0", "1", "0", "0", "0"]
"""Translation and quaternion, w first."""
_LARGEST_HEADER = 1 << 16
_BLOCK = 1 << 14
"""Points that are read at once."""
_LARGEST_POINT = 1 << 16
"""Bytes that a point has at most; the largest descriptors of the library have a few thousand."""


def read_pcd(path: str | Path) -> Columns:
    """Return all fields of a PCD file, with the types that its header states; padding ("_") is left out.

    The viewpoint is not applied: points stay in the frame they are stored in.

    Raises:
        InputError: not readable, not a PCD file, or a header that is inconsistent or does not fit the data.
    """
    with open_bounded(path) as (stream, size):
        header, begin = _read_header(path, stream)
        dtype = _point_type(path, header)
        if "WIDTH" not in header and "POINTS" in header:
            header["WIDTH"] = header["POINTS"]
        width, height = _integer(path, header, "WIDTH"), _integer(path, header, "HEIGHT", 1)
        points = _integer(path, header, "POINTS", width * height)
        if points != width * height:
            _fail(path, f"the header says {points} points, but {width} x {height} of them")
        _check_viewpoint(path, header.get("VIEWPOINT", _NO_VIEWPOINT))
        match header["DATA"]:
            case ["ascii"]:
                lines = stream.read(begin).count(b"\n")
                table = parse_table(path, memoryview(stream.read()), dtype, points, first_line=lines + 1)
            case ["binary"]:
                stream.seek(begin)
                return Columns(_read_binary(path, stream, size - begin, dtype, points), height, str(path))
            case ["binary_compressed"]:
                stream.seek(begin)
                table = _parse_compressed(path, memoryview(stream.read()), dtype, points)
            case other:
                _fail(path, f"DATA is {' '.join(other)!r}, expected ascii, binary or binary_compressed")
    return Columns({name: table[name] for name in _named(dtype)}, height, str(path))


def write_pcd(path: str | Path, columns: dict[str, NDArray[Any]]) -> None:
    """Write columns (N,) as a binary PCD file, with the types that they have.

    Raises:
        InputError: columns that differ in length, or a file that cannot be written.
    """
    n = len(next(iter(columns.values())))
    if any(values.shape != (n,) for values in columns.values()):
        raise InputError(f"{path}: columns differ in length: { ({k: v.shape for k, v in columns.items()}) }")
    table = np.empty(n, dtype=[(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    kinds = [values.dtype.kind.upper() for values in columns.values()]
    header = "\n".join(
        [
            "# .PCD v0.7 - Point Cloud Data file format",
            "VERSION 0.7",
            f"FIELDS {' '.join(columns)}",
            f"SIZE {' '.join(str(values.dtype.itemsize) for values in columns.values())}",
            f"TYPE {' '.join(kinds)}",
            f"COUNT {' '.join('1' for _ in columns)}",
            f"WIDTH {n}",
            "HEIGHT 1",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {n}",
            "DATA binary\n",
        ]
    )
    write_atomically(path, header.encode() + table.tobytes())


def _fail(path: str | Path, problem: str) -> NoReturn:
    raise InputError(f"{path}: not a usable PCD file: {problem}")


def _read_header(path: str | Path, stream: BinaryIO) -> tuple[dict[str, list[str]], int]:
    """Return the entries of the header by keyword, and where the line after DATA begins; the stream is at its start."""
    header: dict[str, list[str]] = {}
    head = io.BytesIO(stream.read(_LARGEST_HEADER))
    stream.seek(0)
    for raw in head:
        words = raw.decode("latin-1").split()
        if not words or words[0].startswith("#"):
            continue
        key = words[0].upper()
        if key not in _KEYS and "FIELDS" in header:
            continue  # an entry beyond the standard
        if key not in _KEYS:
            _fail(path, f"expected one of the keywords {', '.join(_KEYS)}, found {words[0][:40]!r}")
        header["FIELDS" if key == "COLUMNS" else key] = words[1:]
        if key == "DATA":
            return header, head.tell()
    _fail(path, "its header has no line 'DATA ...'")


def _named(dtype: np.dtype[Any]) -> list[str]:
    """Return the names of the fields that are no padding."""
    return [name for name in dtype.names or () if not name.startswith("_")]


def _check_viewpoint(path: str | Path, words: list[str]) -> None:
    """Warn that the viewpoint of a cloud is not applied, if it has one."""
    try:
        moved = [float(word) for word in words] != [float(word) for word in _NO_VIEWPOINT]
    except ValueError:
        _fail(path, f"expected seven numbers after VIEWPOINT, found {' '.join(words)[:60]!r}")
    if moved:
        _LOG.warning("%s: the viewpoint %s is not applied", path, " ".join(words))


def _integer(path: str | Path, header: dict[str, list[str]], key: str, default: int | None = None) -> int:
    """Return the one number >= 0 after a keyword."""
    words = header.get(key, [] if default is None else [str(default)])
    if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 18:
        _fail(path, f"expected one number >= 0 after {key}, found {' '.join(words)[:40]!r}")
    return int(words[0])


def _point_type(path: str | Path, header: dict[str, list[str]]) -> np.dtype[Any]:
    """Return the structured type of one point."""
    names = header.get("FIELDS", [])
    if not names:
        _fail(path, "its header has no line 'FIELDS ...'")
    counts = header.get("COUNT", ["1"] * len(names))
    for key, words in (("SIZE", header.get("SIZE", [])), ("TYPE", header.get("TYPE", [])), ("COUNT", counts)):
        if len(words) != len(names):
            _fail(path, f"{len(names)} fields, but {len(words)} entries after {key}")
    parts: list[tuple[Any, ...]] = []
    kinds = [kind.upper() for kind in header["TYPE"]]
    for i, (name, size, kind, count) in enumerate(zip(names, header["SIZE"], kinds, counts, strict=True)):
        if (kind, size) not in _TYPES:
            _fail(path, f"field '{name}' has type {kind}, size {size}; expected F 4|8, I or U 1|2|4|8")
        if not count.isdecimal() or len(count) > 5:
            _fail(path, f"field '{name}' has count {count[:40]!r}; expected a number from 0 to 99999")
        if int(count) == 0:  # padding of no bytes
            continue
        code = _TYPES[kind, size]
        if name in names[:i] and name != "_":
            _LOG.warning("%s: field '%s' is there twice; the first is read", path, name)
        name = f"_{i}" if name == "_" or name in names[:i] else name
        parts.append((name, code) if count == "1" else (name, code, (int(count),)))
    dtype = np.dtype(parts)
    if not dtype.itemsize:
        _fail(path, f"its fields ({' '.join(names)[:60]}) have no values; expected a COUNT of 1 or more")
    if dtype.itemsize > _LARGEST_POINT:
        _fail(path, f"a point of {dtype.itemsize} bytes; expected at most {_LARGEST_POINT}")
    return dtype


def _read_binary(
    path: str | Path, stream: BinaryIO, length: int, dtype: np.dtype[Any], points: int
) -> dict[str, NDArray[Any]]:
    """Return the fields of the points that a stream has next, read block by block, so that nothing is there twice.

    Less than a point may follow them, or zeros: PCL 1.7 and 1.8 fill a page with these.
    """
    extra = length - points * dtype.itemsize
    columns: dict[str, NDArray[Any]] = {}
    if extra >= 0:  # or memory would be allocated for what the header promises
        columns = {name: np.empty((points, *dtype[name].shape), dtype[name].base) for name in _named(dtype)}
        for first in range(0, points, _BLOCK):
            n = min(_BLOCK, points - first)
            raw = stream.read(n * dtype.itemsize)
            if len(raw) < n * dtype.itemsize:  # it was cut short meanwhile
                extra = first * dtype.itemsize + len(raw) - points * dtype.itemsize
                break
            block = np.frombuffer(raw, dtype)
            for name, values in columns.items():
                values[first : first + n] = block[name]
    if not (0 <= extra < dtype.itemsize or (extra >= 0 and _zeros(stream))):
        _fail(
            path,
            f"the header promises {points} points of {dtype.itemsize} bytes, {points * dtype.itemsize} in all; "
            f"{points * dtype.itemsize + extra} bytes follow it",
        )
    return columns


def _zeros(stream: BinaryIO) -> bool:
    """Return whether all that a stream has left is zeros."""
    while piece := stream.read(1 << 20):
        if any(piece):
            return False
    return True


def _parse_compressed(path: str | Path, body: memoryview, dtype: np.dtype[Any], points: int) -> NDArray[Any]:
    """Return the points of a compressed body: two sizes (uint32), then the values field by field."""
    if len(body) < 8:
        _fail(path, f"expected two sizes of 4 bytes after the header, {len(body)} bytes follow it")
    packed, unpacked = (int(size) for size in np.frombuffer(body, "<u4", 2))
    if unpacked != points * dtype.itemsize:
        _fail(path, f"{points} points of {dtype.itemsize} bytes, but {unpacked} bytes after decompression")
    if packed > len(body) - 8:
        _fail(path, f"{packed} compressed bytes are promised, {len(body) - 8} are there")
    try:
        raw = lzf_decompress(bytes(body[8 : 8 + packed]), unpacked)
    except InputError as error:
        _fail(path, str(error))
    table = np.empty(points, dtype)
    start = 0
    for name in dtype.names or ():
        field = dtype[name]
        table[name] = np.frombuffer(raw, field.base, points * (field.itemsize // field.base.itemsize), start).reshape(
            points, *field.shape
        )
        start += points * field.itemsize
    return table
