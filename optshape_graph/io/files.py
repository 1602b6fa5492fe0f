"""Bounded reading of files, and writing that never leaves half a file under the final name."""

from __future__ import annotations

import contextlib
import io
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from optshape_graph.errors import InputError

LARGEST_FILE = 2 << 30
"""Bytes that a data file has at most (2 GiB), far more than any single scan."""

_PIECE = 1 << 20


def is_file(path: Path) -> bool:
    """Return whether there is a file of that name, whatever the name (too long, with a NUL, ...)."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def inside(path: Path, folder: Path, what: str) -> Path:
    """Return a path with its links followed, if it stays in a folder or in a folder of it.

    Args:
        path: that a file in the folder names.
        folder: that the path must stay in.
        what: the folder in words, for messages.

    Raises:
        InputError: the path leads out of the folder, or is not a path.
    """
    try:
        place = path.resolve()
    except (OSError, ValueError, RuntimeError) as error:  # a NUL in the name, a loop of links
        raise InputError(f"{str(path)!r}: not the name of a file ({error})") from error
    if not place.is_relative_to(folder.resolve()):
        raise InputError(f"{path}: leads out of {what} {folder}, to {place}")
    return path


def read_bytes(path: str | Path, largest: int = LARGEST_FILE) -> bytes:
    """Return the whole content of a file.

    Raises:
        InputError: the file is missing, a folder, not readable, or larger than `largest` bytes.
    """
    with _opened(Path(path)) as (stream, expected):
        return _content(path, stream, expected, largest)


@contextlib.contextmanager
def open_bounded(path: str | Path, largest: int = LARGEST_FILE) -> Iterator[tuple[BinaryIO, int]]:
    """Open a file to be read here and there; a pipe is read whole before.

    Args:
        path: of the file.
        largest: bytes that it may have.

    Yields:
        The stream, and its length in bytes.

    Raises:
        InputError: as `read_bytes`, or reading fails meanwhile.
    """
    with _opened(Path(path)) as (stream, size):
        if stream.seekable() and size <= largest:
            yield stream, size
        else:
            content = _content(path, stream, size, largest)
            yield io.BytesIO(content), len(content)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[BinaryIO, int]]:
    """Open a file, and say how many bytes are expected; what goes wrong until the end of the block is an InputError."""
    try:
        expected = _check_regular(path)
        with path.open("rb") as stream:
            yield stream, expected
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except InputError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path}: cannot be read ({_reason(error)})") from error


def _content(path: str | Path, stream: BinaryIO, expected: int, largest: int) -> bytes:
    """Return all that a stream has left."""
    pieces, size = list[bytes](), 0
    # read(n) allocates n bytes at once: the size of a file, or a piece of a pipe
    while size <= largest and (piece := stream.read(min(expected, largest) + 1 if not size else _PIECE)):
        pieces.append(piece)
        size += len(piece)
    if size > largest:
        raise InputError(f"{path}: larger than {largest} bytes, the most that is read of such a file")
    return b"".join(pieces)  # of one piece: without a copy


def _check_regular(path: Path) -> int:
    """Return the size of a file, or of a piece of a pipe; refuse anything else.

    A device has no end, and reading a named pipe may wait for ever. The pipes that a shell makes of `<(...)`, and
    /dev/stdin, are read.
    """
    found = path.stat()
    mode = found.st_mode
    if stat.S_ISREG(mode):
        return found.st_size
    if stat.S_ISFIFO(mode) and path.parts[:2] in (("/", "dev"), ("/", "proc")):
        return _PIECE
    kind = "folder" if stat.S_ISDIR(mode) else "named pipe" if stat.S_ISFIFO(mode) else "device"
    raise InputError(f"{path}: expected a file, found a {kind}")


def read_head(path: str | Path, size: int) -> bytes:
    """Return the first bytes of a regular file; none of anything else.

    Raises:
        InputError: the file is missing or not readable.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            return b""
        with path.open("rb") as stream:
            return stream.read(size)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({_reason(error)})") from error


def read_text(path: str | Path, largest: int = LARGEST_FILE) -> str:
    """Return the content of a UTF-8 text file, without its byte order mark.

    Raises:
        InputError: as `read_bytes`, or the file is not UTF-8 text.
    """
    data = read_bytes(path, largest)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected UTF-8 text, found byte 0x{data[error.start]:02x} at position {error.start}"
        ) from error


def write_atomically(path: str | Path, data: bytes | str) -> None:
    """Write a file whole or not at all; see `open_atomically`.

    Raises:
        InputError: the place cannot be written (no such folder, read-only, full disk, ...); nothing is left behind.
    """
    with open_atomically(path) as stream:
        stream.write(data.encode() if isinstance(data, str) else data)


@contextlib.contextmanager
def open_atomically(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file to be written whole or not at all.

    The data go to a temporary file in the same folder, reach the disk, and are then renamed: a reader of `path`
    sees the old content or the new one. A device or pipe (/dev/stdout) is written to as it is.

    Args:
        path: of the file.

    Yields:
        The stream to write to.

    Raises:
        InputError: the place cannot be written (no such folder, read-only, full disk, ...); nothing is left behind.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            with path.open("wb") as stream:
                yield stream
            return
        final = path.resolve()  # a symbolic link stays; its destination is replaced
        temporary = final.with_name(f".{final.name[:200]}.{secrets.token_hex(4)}.tmp")
        with temporary.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        if final.exists():
            temporary.chmod(final.stat().st_mode & 0o7777)
        temporary.replace(final)
        temporary = None
        _sync_folder(final.parent)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be written ({_reason(error)})") from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()


def _sync_folder(folder: Path) -> None:
    """Make the rename itself durable, where the file system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _reason(error: Exception) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
