"""One function over many files: its results are the entries of one document, and are kept as they come."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from optshape_graph._version import __version__
from optshape_graph.errors import InputError, OptshapeError
from optshape_graph.io.documents import json_text
from optshape_graph.io.files import open_atomically
from optshape_graph.runs.interruption import going_on
from optshape_graph.runs.journal import Journal, journal_of
from optshape_graph.runs.workers import Lost, Pool

Progress = Callable[[int, int], None]
"""Called with the numbers of finished and of all files."""

UNREADABLE = "unreadable"
"""Status of a file that cannot be read as expected."""

LEAST_CHUNKS = 16
"""A run is split in so many chunks at least, files permitting, so that as many workers have something to do."""

LIST = "scans"
"""Key of the document's list of entries."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of one file.

    Attributes:
        status: "ok", "ambiguous", "failed" or `UNREADABLE`.
        reasons: why it is not ok, a line for each reason.
        entry: its entry in the document, plain data.
        pictures: files with its pictures.
    """

    status: str
    reasons: tuple[str, ...]
    entry: Mapping[str, Any]
    pictures: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Kept:
    """A function that returns its outcomes as lines of the journal, so that workers encode entries, too."""

    function: Callable[[Sequence[str]], Sequence[Outcome]]

    def __call__(self, paths: Sequence[str]) -> list[dict[str, Any]]:
        return [_line(outcome, path) for outcome, path in zip(self.function(paths), paths, strict=True)]


@contextmanager
def run_files(
    function: Callable[[Sequence[str]], Sequence[Outcome]],
    paths: Sequence[str],
    failed: Callable[[str, str], Outcome],
    *,
    form: str,
    describe: Mapping[str, Any],
    output: Path | None = None,
    pool: Pool | None = None,
    progress: Progress | None = None,
    at_once: int = 1,
) -> Iterator[Journal]:
    """Apply a function to files, and write one document; go on where a stopped run ended.

    Files that are worked on together may differ in rounding from each alone. So chunks depend on nothing but the files'
    order and number, and one that was stopped halfway is done again: the document's bytes stay the same. Where a worker
    is killed twice with a chunk, its files are tried one by one.

    Args:
        function: of some of the paths, returns the outcome of each; importable by name, picklable with what it holds.
        paths: of the files, in the order of the document.
        failed: outcome of a path and a reason, for a file whose worker was killed.
        form: kind of the document, `optshape/<form>/1`.
        describe: plain data that describe what is done with each file.
        output: the document; its journal is beside it until it is written. None: nothing is written.
        pool: the workers; None: this process.
        progress: called as files are finished.
        at_once: most files that the function is given in one call.

    Yields:
        The journal: a line for each file, in their order, with its `status`, `reasons` and `entry` (JSON text).

    Raises:
        InputError: none of the files can be read, or the output or its journal cannot be written.
    """
    what = {"form": form, "version": __version__, **describe, "files": fingerprint(paths)}
    with (
        Journal(journal_of(output), what, len(paths)) as journal,
        going_on(lambda: journal.advice(f"{journal.finished} of {journal.count} files are done")),
    ):
        if progress is not None:
            progress(journal.finished, len(paths))
        for size in sorted({max(1, min(at_once, len(paths) // LEAST_CHUNKS)), 1}, reverse=True):
            for number, lines in (pool or Pool()).run(_Kept(function), _chunks(journal, paths, size)):
                if isinstance(lines, Lost):
                    lines = [] if size > 1 else [_line(failed(paths[number], lines.reason), "")]
                for k, line in enumerate(lines, start=number):
                    journal.add(k, line)
                    if progress is not None:
                        progress(journal.finished, len(paths))
        readable = any(line["status"] != UNREADABLE for line in journal)
        if not readable and len(paths):
            reason = journal[0]["reasons"][0]
            journal.remove()
            raise InputError(reason)
        if output is not None:
            write_entries(output, f"optshape/{form}/1", (line["entry"] for line in journal))
        yield journal
        journal.remove()


def _chunks(journal: Journal, paths: Sequence[str], size: int) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield each chunk of so many files that is not finished: the number of its first file, and all its paths."""

    def first(number: int) -> int:
        return number - number % size

    for number, _ in groupby(journal.todo(), first):
        yield number, tuple(paths[number : number + size])


def write_entries(path: Path, schema: str, entries: Iterator[str]) -> None:
    """Write a document with one list, entry by entry.

    Args:
        path: of the document.
        schema: of the document.
        entries: JSON text of each.

    Raises:
        InputError: the file cannot be written.
    """
    with open_atomically(path) as stream:
        stream.write(f'{{\n  "schema": {json.dumps(schema)},\n  "{LIST}": ['.encode())
        separator = "\n    "
        for entry in entries:
            stream.write(f"{separator}{entry}".encode())
            separator = ",\n    "
        stream.write(b"]\n}\n" if separator == "\n    " else b"\n  ]\n}\n")


def fingerprint(paths: Sequence[str]) -> str:
    """Return a short text that changes if files are replaced or changed: a digest of names, sizes and times.

    Args:
        paths: of the files.
    """
    found = hashlib.sha256()
    for path in paths:
        try:
            state = os.stat(path)
            found.update(f"{path}\0{state.st_size}\0{state.st_mtime_ns}\n".encode(errors="surrogateescape"))
        except (OSError, ValueError):
            found.update(f"{path}\0\n".encode(errors="surrogateescape"))
    return found.hexdigest()[:16]


def _line(outcome: Outcome, path: str) -> dict[str, Any]:
    try:
        entry = json_text(outcome.entry, path, "    ")
    except OptshapeError as error:
        raise OptshapeError(f"{path}: its result cannot be written ({error})") from error
    line = {"status": outcome.status, "reasons": list(outcome.reasons), "entry": entry}
    return line | ({"pictures": list(outcome.pictures)} if outcome.pictures else {})
