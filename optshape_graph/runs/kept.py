"""Results of slow steps, kept in a journal beside an output: a run that was stopped does not repeat them.

A step is known by what it is made of, such as a file, a sensor and a target, not by its number: a calibration is run
again with a view more or another option, and repeats only what has changed. A command holds `keeping(output)` while it
works, and hands what it yields down to `kept(...)` around each slow step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

from optshape_graph._version import __version__
from optshape_graph.errors import EstimationError
from optshape_graph.io.records import from_record, to_record
from optshape_graph.runs.interruption import going_on
from optshape_graph.runs.journal import Journal, digest, journal_of

T = TypeVar("T")

_ANY_RUN = {"form": "kept", "version": __version__}
"""What the journal is of: steps of whatever run, each with what it is made of."""


class Kept:
    """Results of steps by what they are made of; steps may be done in several threads.

    Args:
        journal: that keeps them; None: nothing is kept.
    """

    def __init__(self, journal: Journal | None = None) -> None:
        self._journal, self._lock = journal, Lock()
        self._tasks: dict[str, int] = {str(line.get("of")): line["task"] for line in journal or ()}

    def __call__(self, kind: Any, of: Mapping[str, Any], make: Callable[[], T]) -> T:
        """Return the result of a step: as it was kept, or made now and kept.

        Args:
            kind: type of the result, from which its record is restored (see `io.records`).
            of: all that the result depends on: values that have a record, and files, by `runs.files.fingerprint`.
            make: makes it.

        Raises:
            EstimationError: of `make`; it is kept as a result is.
            InputError: of `make`; or the journal cannot be written, or is damaged.
        """
        if self._journal is None:
            return make()
        key = digest({"kind": str(kind), **{name: to_record(value) for name, value in of.items()}})
        if key not in self._tasks:
            self._add(key, _line_of(make))
        restored: T = self._restored(kind, key)
        return restored

    def _add(self, key: str, line: dict[str, Any]) -> None:
        assert self._journal is not None
        with self._lock:
            task = self._journal.count
            self._journal.add(task, {"of": key, **line})
            self._tasks[key] = task

    def _restored(self, kind: Any, key: str) -> Any:
        """The result out of its line, whether it was just added or not: both ways the same bits."""
        assert self._journal is not None
        line = self._journal[self._tasks[key]]
        if "failed" in line:
            raise EstimationError(str(line["failed"]))
        return from_record(kind, line.get("made"), f"{self._journal.path}: line {self._tasks[key] + 2}")


def _line_of(make: Callable[[], Any]) -> dict[str, Any]:
    try:
        return {"made": to_record(make())}
    except EstimationError as error:
        return {"failed": str(error)}


@contextmanager
def keeping(output: Path | None) -> Iterator[Kept]:
    """Keep the results of steps beside an output until the block ends, in which the output is written.

    Args:
        output: file of the run; None: nothing is kept.

    Yields:
        What keeps them: to be handed to the function that does the steps.

    Raises:
        InputError: the journal is in use, another file, or cannot be written.
    """
    with (
        Journal(journal_of(output), _ANY_RUN, None) as journal,
        going_on(lambda: journal.advice(f"{journal.finished} scans and images were looked at")),
    ):
        yield Kept(journal)
        journal.remove()
