"""The journal of a run: a line for each finished task, so that a stopped run goes on where it was.

The first line describes the run; every other line is a JSON object whose first key is the task's number. A line is
written in one call; half a line at the end, from a killed process, is cut off. The file is locked while a process has
it open, so that a second run with the same output is refused. A run that failed says so in a
last line: the same run goes on after it, and another one begins anew instead of being refused.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
from array import array
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, Self

from optshape_graph.errors import InputError

KIND = "journal of optshape_graph, 1"
"""Kind of the file, stated in the first line."""

MOST_AHEAD = 100_000
"""A task may be finished so many numbers ahead of unfinished ones, if the number of tasks is not known."""

_PIECE = 1 << 18
"""Bytes that are read in one call."""

_FIRST = json.dumps({"kind": KIND}).encode()[:-1]
"""Beginning of every journal."""

_FAILED = json.dumps({"failed": True}).encode()
"""What the last line of a run that failed is."""

_TASK = re.compile(rb'\{"task": (\d{1,12}),')


class Journal:
    """The finished tasks of a run, on disk; only the place of each line is in memory.

    Args:
        path: of the journal; None: it is dropped when it is closed.
        describe: plain data that describe the run; the journal of another run is refused.
        count: number of the tasks; None: not known in advance.

    Raises:
        InputError: the file holds another run, is in use, or cannot be written.
    """

    def __init__(self, path: Path | None, describe: Mapping[str, Any], count: int | None) -> None:
        self.path = path
        self.finished = 0
        self._places = array("q", [-1]) * (count or 0)
        self._file = _unnamed() if path is None else _locked(path)
        try:
            self._begin({"kind": KIND, "digest": digest({**describe, "tasks": count}), "tasks": count}, count)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        failed = kind is not None and issubclass(kind, Exception)  # not merely stopped
        if failed and self.finished and not self._file.closed:  # nor removed
            with suppress(InputError):
                self._append({"failed": True})
        self.close()

    @property
    def count(self) -> int:
        """Number of the tasks; if it is not known, of those up to the last finished one."""
        return len(self._places)

    def __contains__(self, task: int) -> bool:
        return task < len(self._places) and self._places[task] >= 0

    def __getitem__(self, task: int) -> dict[str, Any]:
        line, place = b"", self._places[task]
        while b"\n" not in line:
            piece = os.pread(self._file.fileno(), _PIECE, place + len(line))
            if not piece:
                break
            line += piece
        return self._parsed(line.partition(b"\n")[0], task)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Yield the lines of the finished tasks, in the order of the tasks."""
        return (self[task] for task in range(self.count) if task in self)

    def todo(self) -> Iterator[int]:
        """Yield the numbers of the tasks that are not finished."""
        return (task for task in range(self.count) if self._places[task] < 0)

    def add(self, task: int, line: Mapping[str, Any]) -> None:
        """Add the result of a task.

        Args:
            task: its number.
            line: plain data with finite numbers.

        Raises:
            InputError: the disk is full, or the file cannot be written.
        """
        if task in self:
            return
        self._note(task, self._append({"task": task, **line}))

    def _append(self, line: Mapping[str, Any]) -> int:
        """Write a line at the end, whole or not at all; return its place."""
        place = self._file.seek(0, os.SEEK_END)
        try:
            left = memoryview(json.dumps(line, allow_nan=False).encode() + b"\n")
            while left:  # a disk that is nearly full takes a part first, and fails with the next
                left = left[self._file.write(left) :]
        except OSError as error:
            self._file.truncate(place)
            raise InputError(
                f"{self.path or 'temporary file'}: cannot be written ({error.strerror or error})"
            ) from error
        return place

    def _note(self, task: int, place: int) -> None:
        """Note the place of a task's line."""
        if task >= len(self._places):
            self._places.extend([-1] * (task + 1 - len(self._places)))
        self.finished += self._places[task] < 0
        self._places[task] = place

    def advice(self, what: str) -> str:
        """Return what is kept of a stopped run, and how to go on.

        Args:
            what: the finished part: "3 of 5 files are done".
        """
        if self.path is None:
            return f"{what}; nothing is kept without --json"
        if not self.finished:
            return what
        return f"{what}, and kept in {self.path}; the same command goes on there"

    def close(self) -> None:
        """Close and unlock the file; remove it if no task is finished."""
        if self.path is not None and not self.finished:
            self.path.unlink(missing_ok=True)
        self._file.close()

    def remove(self) -> None:
        """Remove the file, once the output is written."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
        self.close()

    def _begin(self, header: dict[str, Any], count: int | None) -> None:
        lines = self._lines()
        first, second = next(lines, None), next(lines, None)
        found = None if first is None else self._parsed(first[1], None)
        if not self._new() if found is None else found.get("kind") != KIND:
            raise InputError(f"{self.path}: expected the journal of a run, found another file; choose another output")
        if first is None or second is None:  # no task is finished: the journal is new, or its run was killed at once
            self._file.truncate(0)
            self._append(header)
            return
        if found != header:
            last = deque(lines, 1)
            if last and last[0][1] == _FAILED:  # its user has found out why
                self._file.truncate(0)
                self._append(header)
                return
            raise InputError(
                f"{self.path}: holds what is finished of another run (other inputs, options or version); go on with "
                "the same command as before, or remove it to begin anew"
            )
        for place, line in chain([second], lines):
            if line == _FAILED:
                break
            match = _TASK.match(line)
            if match is None or int(match[1]) >= (self.finished + MOST_AHEAD if count is None else count):
                raise InputError(f"{self.path}: not a line of a journal at byte {place}; remove the file to begin anew")
            self._note(int(match[1]), place)
            end = place + len(line) + 1
        self._file.truncate(end)

    def _new(self) -> bool:
        """Return whether the file is empty, or has only the beginning of a first line."""
        start = os.pread(self._file.fileno(), len(_FIRST), 0)
        return _FIRST.startswith(start)

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        """Yield the whole lines of the file, each with its place. Without a buffer, a line is one write."""
        place, offset, rest = 0, 0, b""
        while piece := os.pread(self._file.fileno(), _PIECE, offset):
            offset += len(piece)
            *whole, rest = (rest + piece).split(b"\n")
            for line in whole:
                yield place, line
                place += len(line) + 1

    def _parsed(self, line: bytes, task: int | None) -> dict[str, Any]:
        try:
            value = json.loads(line)
        except ValueError:
            value = None
        if not isinstance(value, dict) or (task is not None and value.get("task") != task):
            raise InputError(f"{self.path}: not the journal of a run; choose another output, or remove it")
        return value


def journal_of(output: Path | None) -> Path | None:
    """Return the path of an output file's journal, beside it; None if the output is no file, as /dev/stdout."""
    if output is None or (output.exists() and not output.is_file()):
        return None
    return output.with_name(f"{output.name}.journal")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder for one run, while the block runs.

    Args:
        folder: to which the run writes.

    Raises:
        InputError: another run has locked it.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{folder}: in use: another run writes to it") from error
        yield
    finally:
        os.close(handle)


def digest(describe: Mapping[str, Any]) -> str:
    """Return a short text that differs for different plain data, which may have arrays."""
    text = json.dumps(describe, sort_keys=True, default=lambda value: value.tolist())
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _unnamed() -> BinaryIO:
    import tempfile

    return tempfile.TemporaryFile(buffering=0)


def _locked(path: Path) -> BinaryIO:
    """Open a file for reading and appending, and lock it against other processes."""
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from error
        file: BinaryIO = os.fdopen(handle, "r+b", buffering=0)  # a line is one write
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.close()
            raise InputError(f"{path}: in use: another run writes the same output") from error
        try:
            if os.fstat(handle).st_ino == path.stat().st_ino:
                return file
        except FileNotFoundError:
            pass
        file.close()  # the run that had it has just finished and removed it
