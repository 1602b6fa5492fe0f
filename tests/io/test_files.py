"""Bounded reading, and writing whole files or none."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest

from optshape_graph import InputError
from optshape_graph.io.files import read_bytes, read_text, write_atomically


def test_written_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_atomically(path, b"\x00\xff")
    assert read_bytes(path) == b"\x00\xff"
    write_atomically(path, "ä\n")
    assert read_text(path) == "ä\n"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_new_files_follow_the_umask_and_old_ones_keep_their_mode(tmp_path: Path) -> None:
    umask = os.umask(0o027)
    try:
        write_atomically(tmp_path / "new", "x")
    finally:
        os.umask(umask)
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o640
    (tmp_path / "new").chmod(0o604)
    write_atomically(tmp_path / "new", "y")
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o604


def test_a_symbolic_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "folder" / "real")
    write_atomically(link, "x")
    assert link.is_symlink()
    assert (tmp_path / "folder" / "real").read_text() == "x"


def test_a_device_is_written_to_as_it_is() -> None:
    write_atomically("/dev/null", "x")
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failure_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = tmp_path / "a.json"
    write_atomically(path, "old")

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full) if step == "fsync" else monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(InputError, match=r"a\.json: cannot be written \(No space left on device\)"):
        write_atomically(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_a_full_device() -> None:
    with pytest.raises(InputError, match=r"/dev/full: cannot be written \(No space left on device\)"):
        write_atomically("/dev/full", "x")


def test_an_interruption_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "a.json", "new")
    assert list(tmp_path.iterdir()) == []


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "no" / "a", tmp_path / "file" / "a", tmp_path, tmp_path / "a\0b", tmp_path / ("n" * 300)):
        with pytest.raises(InputError, match="cannot be written"):
            write_atomically(path, "x")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="Permission denied"):
        write_atomically(tmp_path / "a", "x")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "latin").write_bytes(b"caf\xe9")
    (tmp_path / "long").write_bytes(b"12345")
    (tmp_path / "bom").write_bytes(b"\xef\xbb\xbfx")
    with pytest.raises(InputError, match="no such file"):
        read_bytes(tmp_path / "absent")
    with pytest.raises(InputError, match="expected a file, found a folder"):
        read_bytes(tmp_path)
    with pytest.raises(InputError, match="cannot be read"):
        read_bytes(tmp_path / "a\0b")
    with pytest.raises(InputError, match="larger than 4 bytes"):
        read_bytes(tmp_path / "long", largest=4)
    with pytest.raises(InputError, match="expected UTF-8 text, found byte 0xe9 at position 3"):
        read_text(tmp_path / "latin")
    with pytest.raises(InputError, match="/dev/zero: expected a file, found a device"):
        read_bytes("/dev/zero")
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(InputError, match="expected a file, found a named pipe"):
        read_bytes(tmp_path / "fifo")
    assert read_text(tmp_path / "bom") == "x"
