"""Results of slow steps, kept in a journal beside an output, so that the next run does not repeat them.

A step is identified by its inputs, such as a file, a sensor and a target, not by a number: if a calibration is run
again with another view or option, only changed steps are repeated. A command holds `keeping(output)` while it works,
and passes the `kept` that it yields down; the library calls `kept(...)` for each slow step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
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
"""Description of the journal: steps of any run, each identified by its inputs."""


class Kept:
    """Results of steps by their inputs; steps may run in several threads.

    Args:
        journal: for the results; None: nothing is kept.
    """

    def __init__(self, journal: Journal | None = None) -> None:
        self._journal, self._lock = journal, Lock()
        self._tasks: dict[str, int] = {str(line.get("of")): line["task"] for line in journal or ()}

    def __call__(self, kind: Any, of: Mapping[str, Any], make: Callable[[], T]) -> T:
        """Return the kept result of a step, or make it now and keep it.

        Args:
            kind: type of the result, by which its record is restored (see `io.records`).
            of: all inputs of the step: values that have a record, and files by `runs.files.fingerprint`.
            make: makes the result.

        Raises:
            EstimationError: from `make`; it is kept like a result.
            InputError: from `make`; or the journal cannot be written, or is damaged.
        """
        (found,) = self.together(kind, [of], lambda: [_caught(make)])
        if isinstance(found, EstimationError):
            raise found
        return found

    def together(
        self, kind: Any, steps: Sequence[Mapping[str, Any]], make: Callable[[], Sequence[T | EstimationError]]
    ) -> list[T | EstimationError]:
        """Return the kept results of steps that are made together; all are made again where one is not kept.

        Args:
            kind: type of the results.
            steps: all inputs of each.
            make: makes the results of all, or the errors, which are kept likewise.

        Raises:
            InputError: from `make`; or the journal cannot be written, or is damaged.
        """
        if self._journal is None:
            return list(make())
        keys = [digest({"kind": str(kind), **{name: to_record(value) for name, value in of.items()}}) for of in steps]
        if any(key not in self._tasks for key in keys):
            for key, made in zip(keys, make(), strict=True):
                if key not in self._tasks:
                    failed = isinstance(made, EstimationError)
                    self._add(key, {"failed": str(made)} if failed else {"made": to_record(made)})
        return [_caught(partial(self._restored, kind, key)) for key in keys]

    def _add(self, key: str, line: dict[str, Any]) -> None:
        assert self._journal is not None
        with self._lock:
            task = self._journal.count
            self._journal.add(task, {"of": key, **line})
            self._tasks[key] = task

    def _restored(self, kind: Any, key: str) -> Any:
        """Return the result from its line, also if the line is new, so that the bits are always the same."""
        assert self._journal is not None
        line = self._journal[self._tasks[key]]
        if "failed" in line:
            raise EstimationError(str(line["failed"]))
        return from_record(kind, line.get("made"), f"{self._journal.path}: line {self._tasks[key] + 2}")


def _caught(make: Callable[[], T]) -> T | EstimationError:
    try:
        return make()
    except EstimationError as error:
        return error


@contextmanager
def keeping(output: Path | None) -> Iterator[Kept]:
    """Keep the results of steps beside an output, until the end of the block in which the output is written.

    Args:
        output: file of the run; None: nothing is kept.

    Yields:
        The object that keeps results, for the function that does the steps.

    Raises:
        InputError: the journal is in use, another file, or cannot be written.
    """
    with (
        Journal(journal_of(output), _ANY_RUN, None) as journal,
        going_on(lambda: journal.advice(f"{journal.finished} scans and images were looked at")),
    ):
        yield Kept(journal)
        journal.remove()
