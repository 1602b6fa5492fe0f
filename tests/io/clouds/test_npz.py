"""NPZ: plain arrays come in, objects and lying headers do not."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.io.clouds.npz import read_npz
from tests.io.refusal import read_or_refused


def npy(shape: tuple[int, ...], data: bytes, descr: str = "<f8", version: tuple[int, int] = (1, 0)) -> bytes:
    """An array's file with the header that is asked for."""
    stream = io.BytesIO()
    header: dict[str, Any] = {"descr": descr, "fortran_order": False, "shape": shape}
    write = np.lib.format.write_array_header_1_0 if version == (1, 0) else np.lib.format.write_array_header_2_0
    write(stream, header)
    return stream.getvalue() + data


def archive(path: Path, **members: bytes) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)


def test_arrays_come_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    arrays = {"xyz": np.arange(6.0).reshape(2, 3), "ring": np.array([1, 2], "u1"), "name": np.array("x")}
    for save in (np.savez, np.savez_compressed):
        save(path, **arrays)
        found = read_npz(path).values
        assert list(found) == list(arrays)
        for name, values in arrays.items():
            assert found[name].dtype == values.dtype
            np.testing.assert_array_equal(found[name], values)
    archive(path, xyz=npy((1, 3), np.ones(3).tobytes(), version=(2, 0)))
    np.testing.assert_array_equal(read_npz(path).values["xyz"], np.ones((1, 3)))


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return (pytest.fail, ("unpickled",))

    np.savez(tmp_path / "a.npz", xyz=np.array([Trap()], dtype=object))
    with pytest.raises(InputError, match=r"array 'xyz\.npy' holds Python objects; expected numbers"):
        read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (npy((10**12, 3), b"\x00" * 24), "promises 24000000000000 bytes of data, 24 are there"),
        (npy((2, 3), b"\x00" * 47), "promises 48 bytes of data, 47 are there"),
        (npy((-2, 3), b""), "promises -48 bytes"),
        (b"not an array", "not a usable NPZ file: the magic string is not correct"),
        (b"", "not a usable NPZ file"),
        (b"\x93NUMPY\x01\x00\x20\x00{'descr': os.system('x')}  ", "not a usable NPZ file"),
        (b"\x93NUMPY\x01\x00\xff\xff{", "not a usable NPZ file"),
    ],
)
def test_arrays_that_are_refused(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "bad.npz"
    archive(path, xyz=data)
    with pytest.raises(InputError, match=message) as raised:
        read_npz(path)
    assert str(raised.value).startswith(str(path))


def test_files_that_are_no_archives(tmp_path: Path) -> None:
    good = tmp_path / "good.npz"
    np.savez_compressed(good, xyz=np.arange(300.0).reshape(-1, 3))
    data = bytearray(good.read_bytes())
    for name, content in (("empty", b""), ("noise", b"\x80\x04noise"), ("cut", bytes(data[: len(data) // 2]))):
        (tmp_path / f"{name}.npz").write_bytes(content)
        with pytest.raises(InputError, match="not a usable NPZ file"):
            read_npz(tmp_path / f"{name}.npz")
    data[100] ^= 255
    good.write_bytes(data)
    with pytest.raises(InputError, match="not a usable NPZ file"):
        read_npz(good)


@given(st.binary(min_size=1, max_size=20), st.integers(0, 500))
def test_damaged_files_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, noise: bytes, start: int) -> None:
    path = tmp_path_factory.mktemp("npz") / "a.npz"
    np.savez_compressed(path, xyz=np.arange(6.0).reshape(-1, 3), ring=np.arange(2))
    good = path.read_bytes()
    path.write_bytes(good[:start] + noise + good[start + len(noise) :])
    with read_or_refused(path):
        read_npz(path)
