"""PCD: round trips in all three encodings, and headers that lie."""

from __future__ import annotations

import logging
import os
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from optshape_graph import InputError
from optshape_graph.io.clouds import read_scan
from optshape_graph.io.clouds.pcd import read_pcd, write_pcd
from tests.io.clouds.test_lzf import compress
from tests.io.refusal import read_or_refused

TYPES = ["f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"]

tables = npst.arrays(
    st.lists(st.sampled_from(TYPES), min_size=1, max_size=5).map(
        lambda kinds: np.dtype([(f"c{i}", f"<{kind}") for i, kind in enumerate(kinds)])
    ),
    st.integers(0, 8),
)


def pcd(
    table: np.ndarray[Any, np.dtype[Any]], encoding: str = "ascii", body: bytes | None = None, **header: object
) -> bytes:
    """A PCD file of a structured array; `header` replaces lines."""
    names = table.dtype.names or ()
    lines = {
        "VERSION": "0.7",
        "FIELDS": " ".join(names),
        "SIZE": " ".join(str(table.dtype[n].base.itemsize) for n in names),
        "TYPE": " ".join(table.dtype[n].base.kind.upper() for n in names),
        "COUNT": " ".join(str(int(np.prod(table.dtype[n].shape))) for n in names),
        "WIDTH": len(table),
        "HEIGHT": 1,
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": len(table),
        "DATA": encoding,
    } | header
    if body is None:
        fields = b"".join(np.ascontiguousarray(table[n]).tobytes() for n in names)
        packed = compress(fields)
        rows = [" ".join(str(x) for n in names for x in np.ravel(row[n])) for row in table]
        body = {
            "ascii": "\n".join(rows).encode(),
            "binary": table.tobytes(),
            "binary_compressed": struct.pack("<II", len(packed), len(fields)) + packed,
        }[encoding]
    head = "".join(f"{key} {value}\n" for key, value in lines.items() if value is not None)
    return b"# .PCD v0.7 - Point Cloud Data file format\n" + head.encode() + body


CLOUD = np.array([(1.5, 2, 3, 7), (4, np.nan, 6, 8)], dtype=[("x", "<f4"), ("y", "<f8"), ("z", "<f4"), ("ring", "<u2")])


@given(tables, st.sampled_from(["ascii", "binary", "binary_compressed"]))
def test_every_type_in_every_encoding(
    tmp_path_factory: pytest.TempPathFactory, table: np.ndarray[Any, np.dtype[Any]], encoding: str
) -> None:
    path = tmp_path_factory.mktemp("pcd") / "a.pcd"
    path.write_bytes(pcd(table, encoding))
    found = read_pcd(path)
    assert list(found.values) == list(table.dtype.names or ())
    for name, values in found.values.items():
        assert values.dtype == table.dtype[name]
        np.testing.assert_array_equal(values, table[name])


@given(tables)
def test_written_is_read_back(tmp_path_factory: pytest.TempPathFactory, table: np.ndarray[Any, np.dtype[Any]]) -> None:
    path = tmp_path_factory.mktemp("pcd") / "a.pcd"
    columns = {name: table[name] for name in table.dtype.names or ()}
    write_pcd(path, columns)
    for name, values in read_pcd(path).values.items():
        np.testing.assert_array_equal(values, columns[name])


def test_counts_padding_organised_and_old_headers(tmp_path: Path) -> None:
    dtype = np.dtype([("xyz", "<f4", (3,)), ("pad", "u1", (4,)), ("pad2", "u1"), ("t", "<u4")])
    table = np.array([((1, 2, 3), (0, 0, 0, 0), 9, 5), ((4, 5, 6), (0, 0, 0, 0), 9, 6)], dtype)
    path = tmp_path / "a.pcd"
    for encoding in ("ascii", "binary", "binary_compressed"):
        header = {"FIELDS": None, "COLUMNS": "xyz _ _ t", "WIDTH": 1, "HEIGHT": 2, "POINTS": None, "VIEWPOINT": None}
        path.write_bytes(
            pcd(table, encoding, **header)
            .replace(b"COLUMNS xyz _ _ t\n", b"")
            .replace(b"SIZE", b"COLUMNS xyz _ _ t\nSIZE")
        )
        found = read_pcd(path)
        assert found.height == 2
        assert list(found.values) == ["xyz", "t"]
        np.testing.assert_array_equal(found.values["xyz"], table["xyz"])
        np.testing.assert_array_equal(found.values["t"], table["t"])


def test_a_viewpoint_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd(CLOUD, VIEWPOINT="0.0 0 0 1 0 0 0"))
    with caplog.at_level(logging.WARNING):
        read_pcd(path)
        assert caplog.text == ""
        path.write_bytes(pcd(CLOUD, VIEWPOINT="0 0 1.5 1 0 0 0"))
        read_pcd(path)
    assert "the viewpoint 0 0 1.5 1 0 0 0 is not applied" in caplog.text


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "its header has no line 'DATA ...'"),
        (b"\x00\xff" * 1000, "expected one of the keywords"),
        (b"ply\n", "expected one of the keywords VERSION, .*, found 'ply'"),
        (pcd(CLOUD, DATA="zip"), "DATA is 'zip', expected ascii, binary or binary_compressed"),
        (pcd(CLOUD, FIELDS=None), "no line 'FIELDS"),
        (pcd(CLOUD, SIZE="4 8 4"), "4 fields, but 3 entries after SIZE"),
        (pcd(CLOUD, SIZE="4 8 4 3"), "field 'ring' has type U, size 3; expected F 4|8, I or U 1|2|4|8"),
        (pcd(CLOUD, TYPE="F F F X"), "field 'ring' has type X"),
        (pcd(CLOUD, TYPE="F F F F"), "field 'ring' has type F, size 2"),
        (pcd(CLOUD, COUNT="1 1 1 x"), "field 'ring' has count 'x'"),
        (pcd(CLOUD, COUNT="1 1 1 -1"), "field 'ring' has count '-1'"),
        (pcd(CLOUD, COUNT="1 1 1 99999999999"), "has count '99999999999'"),
        (pcd(CLOUD, COUNT="1 1 1 99999"), "a point of 200014 bytes"),
        (pcd(CLOUD, WIDTH=3), "the header says 2 points, but 3 x 1"),
        (pcd(CLOUD, WIDTH="two"), "expected one number >= 0 after WIDTH, found 'two'"),
        (pcd(CLOUD, WIDTH="-2"), "expected one number >= 0 after WIDTH, found '-2'"),
        (pcd(CLOUD, WIDTH=None, POINTS=None), "after WIDTH, found ''"),
        (pcd(CLOUD, POINTS="9" * 30), "expected one number >= 0 after POINTS"),
        (pcd(CLOUD, VIEWPOINT="here"), "expected seven numbers after VIEWPOINT, found 'here'"),
        (pcd(CLOUD, WIDTH=3, POINTS=3), "the header promises 3 points, 2 lines of points follow it"),
        (pcd(CLOUD, body=b"1 2 3\n4 5 6\n"), "pcd:13: expected 4 columns but 3 were found"),
        (pcd(CLOUD, body=b"1 2 3 4\n4 5 6 x\n"), "pcd:13: could not convert string 'x' to uint16 in column 4"),
        (pcd(CLOUD, body=b"1 2 3 4\n4 5 6 70000\n"), "could not convert string '70000' to uint16"),
        (pcd(CLOUD, body=b"\x00\xff\xfe\x80" * 9), "could not convert|columns"),
        (pcd(CLOUD, "binary", WIDTH=3, POINTS=3), "promises 3 points of 18 bytes, 54 in all; 36 bytes follow it"),
        (pcd(CLOUD, "binary", WIDTH=1, POINTS=1), "promises 1 points of 18 bytes, 18 in all; 36 bytes follow it"),
        (pcd(CLOUD, "binary")[:-1], "35 bytes follow it"),
        (pcd(CLOUD, "binary_compressed", body=b"\x01"), "expected two sizes of 4 bytes after the header, 1 bytes"),
        (pcd(CLOUD, "binary_compressed")[:-1], "compressed bytes are promised"),
        (pcd(CLOUD, "binary_compressed", WIDTH=3, POINTS=3), "3 points of 18 bytes, but 36 bytes after decompression"),
        (pcd(CLOUD, "binary_compressed", body=struct.pack("<II", 3, 36) + b"\xff\xff\xff"), "damaged compressed data"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "bad.pcd"
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as raised:
        read_pcd(path)
    assert str(raised.value).startswith(str(path))


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_a_promise_of_a_million_million_points_allocates_nothing(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "bad.pcd"
    path.write_bytes(pcd(CLOUD, encoding, WIDTH=10**12, POINTS=10**12))
    tracemalloc.start()
    with pytest.raises(InputError):
        read_pcd(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6


@given(st.binary(max_size=300), st.sampled_from(["ascii", "binary", "binary_compressed"]), st.integers(0, 400))
def test_damaged_files_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, noise: bytes, encoding: str, start: int
) -> None:
    path = tmp_path_factory.mktemp("pcd") / "a.pcd"
    good = pcd(CLOUD, encoding)
    for data in (noise, good[:start] + noise + good[start + len(noise) :], good[:start]):
        path.write_bytes(data)
        with read_or_refused(path):
            read_pcd(path)


def test_columns_that_differ_in_length_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="columns differ in length"):
        write_pcd(tmp_path / "a.pcd", {"x": np.zeros(2), "y": np.zeros(3)})


def test_padding_and_fields_that_others_write(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "a.pcd"
    whole = pcd(CLOUD, "binary")
    for padded in (whole.ljust(4096, b"\0"), whole + b"\n", whole + bytes(7), whole + bytes(100)):
        path.write_bytes(padded)
        np.testing.assert_array_equal(read_pcd(path).values["x"], CLOUD["x"])
    path.write_bytes(whole + bytes(99) + b"1")
    with pytest.raises(InputError, match="bytes follow it"):
        read_pcd(path)
    path.write_bytes(pcd(CLOUD, FIELDS="x y z ring _", SIZE="4 4 4 2 1", TYPE="F F F U U", COUNT="1 1 1 1 0"))
    assert list(read_pcd(path).values) == ["x", "y", "z", "ring"]
    path.write_bytes(pcd(CLOUD, WIDTH=None))
    assert len(read_pcd(path).values["x"]) == len(CLOUD)
    path.write_bytes(pcd(CLOUD).replace(b"WIDTH", b"SENSOR of a newer program\nWIDTH"))
    assert len(read_pcd(path).values["x"]) == len(CLOUD)
    path.write_bytes(pcd(CLOUD, TYPE="f f f u"))
    np.testing.assert_array_equal(read_pcd(path).values["ring"], CLOUD["ring"])
    path.write_bytes(pcd(CLOUD, FIELDS="x y x ring"))
    assert list(read_pcd(path).values) == ["x", "y", "ring"]
    assert "field 'x' is there twice" in caplog.text
    path.write_bytes(pcd(CLOUD, body="\n".join(" ".join(f"{float(v)}" for v in row) for row in CLOUD).encode()))
    assert read_pcd(path).values["ring"].tolist() == CLOUD["ring"].tolist()


def test_blocks_padding_and_a_pipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """More points than a block has, zeros that fill a page, a field of two numbers; the same from a pipe."""
    monkeypatch.setattr("optshape_graph.io.clouds.pcd._BLOCK", 7)
    table = np.zeros(25, [("x", "<f4"), ("_", "u1", (3,)), ("n", "<u2", (2,))])
    table["x"], table["n"] = np.arange(25), np.arange(50).reshape(25, 2)
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd(table, "binary", COUNT="1 3 2") + bytes(100))
    reading, writing = os.pipe()
    os.write(writing, path.read_bytes())
    os.close(writing)
    for found in (read_pcd(path), read_pcd(f"/dev/fd/{reading}")):
        assert list(found.values) == ["x", "n"]
        for name, values in found.values.items():
            np.testing.assert_array_equal(values, table[name])
    os.close(reading)
    path.write_bytes(path.read_bytes()[:-102])  # of the last point, two bytes are missing
    with pytest.raises(InputError, match=r"25 points of 11 bytes, 275 in all; 273 bytes follow it"):
        read_pcd(path)


def test_a_cloud_is_never_in_memory_twice(tmp_path: Path) -> None:
    """2.2 times the file is what a scan holds; the file's bytes beside it would make 3.2."""
    n = 100_000
    columns = {name: np.linspace(1, 2, n, dtype="<f4") for name in ("x", "y", "z", "intensity", "time")}
    write_pcd(tmp_path / "a.pcd", columns | {"ring": (np.arange(n) % 64).astype("<u2")})
    tracemalloc.start()
    read_scan(tmp_path / "a.pcd")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= 3 * (tmp_path / "a.pcd").stat().st_size + (2 << 20)  # a sample of the rings, of any large cloud
