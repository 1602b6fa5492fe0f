"""PLY: ascii and both byte orders, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from optshape_graph import InputError
from optshape_graph.io.clouds.ply import read_ply
from tests.io.refusal import read_or_refused

NAMES = {
    "f4": "float",
    "f8": "double",
    "i1": "char",
    "i2": "int16",
    "i4": "int",
    "u1": "uint8",
    "u2": "ushort",
    "u4": "uint32",
}
FORMATS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}

tables = npst.arrays(
    st.lists(st.sampled_from(list(NAMES)), min_size=1, max_size=5).map(
        lambda kinds: np.dtype([(f"c{i}", f"<{kind}") for i, kind in enumerate(kinds)])
    ),
    st.integers(0, 8),
)
CLOUD = np.array([(1, 2, 3), (4, 5, 6)], dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


def ply(
    table: np.ndarray[Any, np.dtype[Any]], form: str = "ascii", faces: bool = False, count: int | None = None
) -> bytes:
    names = table.dtype.names or ()
    properties = [f"property {NAMES[table.dtype[n].str[1:]]} {n}" for n in names]
    head = [
        "ply",
        f"format {form} 1.0",
        "comment made by a test",
        f"element vertex {len(table) if count is None else count}",
    ]
    tail = ["element face 1", "property list uchar int vertex_indices"] * faces
    header = "\n".join([*head, *properties, *tail, "end_header\n"]).encode()
    if form == "ascii":
        rows = [" ".join(str(row[n]) for n in names) for row in table] + ["3 0 1 2"] * faces
        return header + "\n".join(rows).encode()
    swapped = table.astype(table.dtype.newbyteorder(FORMATS[form]))
    return header + swapped.tobytes() + b"\x03\x00\x00\x00\x00\x00\x00\x00\x01\x00\x00\x00\x02" * faces


@given(tables, st.sampled_from(list(FORMATS)), st.booleans())
def test_every_type_in_every_format(
    tmp_path_factory: pytest.TempPathFactory, table: np.ndarray[Any, np.dtype[Any]], form: str, faces: bool
) -> None:
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    path.write_bytes(ply(table, form, faces))
    found = read_ply(path)
    assert list(found.values) == list(table.dtype.names or ())
    for name, values in found.values.items():
        np.testing.assert_array_equal(values, table[name])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "its first line is not 'ply'"),
        (b"\x00\xff" * 50, "its first line is not 'ply'"),
        (ply(CLOUD).replace(b"end_header\n", b""), "a line that is not understood"),
        (b"ply\nformat ascii 1.0\n", "no line 'end_header'"),
        (ply(CLOUD).replace(b"format ascii 1.0\n", b""), "no line 'format ...', of ascii, binary_little_endian"),
        (ply(CLOUD).replace(b"ascii", b"utf8"), "a line that is not understood: 'format utf8 1.0"),
        (b"ply\nformat ascii 1.0\nend_header\n", "declares no vertices"),
        (
            ply(CLOUD).replace(b"float x", b"list uchar float x"),
            r"the vertices have a list \(property list uchar float x\)",
        ),
        (ply(CLOUD).replace(b"float x", b"quad x"), "a line that is not understood: 'property quad x"),
        (ply(CLOUD).replace(b"float y", b"float x"), "a property is named twice: x x z"),
        (
            ply(CLOUD).replace(b"element vertex", b"element camera 1\nelement vertex"),
            "'camera' comes before the vertices",
        ),
        (ply(CLOUD, count=-1), "a line that is not understood: 'element vertex -1"),
        (ply(CLOUD, count=10**12), "promises 1000000000000 points, 2 lines of points follow it"),
        (
            ply(CLOUD, "binary_little_endian", count=10**12),
            "promises 1000000000000 vertices of 12 bytes, .* 24 bytes follow",
        ),
        (ply(CLOUD, "binary_big_endian")[:-1], "23 bytes follow it"),
        (ply(CLOUD).replace(b"4.0", b"four"), "could not convert string 'four' to float32"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as raised:
        read_ply(path)
    assert str(raised.value).startswith(str(path))


@given(st.binary(max_size=200), st.sampled_from(list(FORMATS)), st.integers(0, 200))
def test_damaged_files_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, noise: bytes, form: str, start: int
) -> None:
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    good = ply(CLOUD, form)
    for data in (noise, good[:start] + noise + good[start + len(noise) :], good[:start]):
        path.write_bytes(data)
        with read_or_refused(path):
            read_ply(path)
