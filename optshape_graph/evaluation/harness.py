"""Many independent tasks, on processes or a cluster, that survive being killed.

Every task is a plain value, and its result plain rows. Results do not depend on the pool: a task draws from its own
seed and computes on one thread, and the table is in the order of the tasks. A finished task is a file, written whole or
not at all, so that a killed sweep goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.documents import read_json, write_json
from optshape_graph.runs.interruption import going_on
from optshape_graph.runs.journal import locked
from optshape_graph.runs.workers import Lost, OneThread, Pool

Row = dict[str, Any]
Progress = Callable[[int, int], None]
"""Called with the numbers of finished and of all tasks."""

T = TypeVar("T")


def run_tasks(
    function: Callable[[T], list[Row]],
    tasks: Sequence[T],
    folder: str | Path,
    describe: Mapping[str, Any],
    *,
    pool: Pool | None = None,
    progress: Progress | None = None,
) -> list[Row]:
    """Run every task that is not finished yet, and return the rows of all, in the order of the tasks.

    Args:
        function: does a task; importable by name, so that another process finds it. Its rows have text, finite
            numbers, truth values and None.
        tasks: arguments of the function; picklable.
        folder: for finished tasks, made if it is missing. Another call with the same description takes them from there.
        describe: plain data that describe the run, with the version; tasks of another description are not mixed in.
        pool: the workers; None: this process.
        progress: called when a task is finished, and once before the first.

    Raises:
        InputError: the folder holds another sweep, or a damaged file; or another run uses it.
        EstimationError: a task's worker was killed twice; the others are finished, and kept.
        MissingExtraError: Dask is asked for, and absent.
    """
    folder = Path(folder)
    _claim(folder, {**describe, "tasks": len(tasks)})
    todo = [number for number in range(len(tasks)) if not _path(folder, number).exists()]
    finished = len(tasks) - len(todo)
    if progress is not None:
        progress(finished, len(tasks))
    lost: dict[int, str] = {}
    with locked(folder), going_on(lambda: f"finished tasks are kept in {folder}; the same command goes on there"):
        for number, rows in (pool or Pool()).run(OneThread(function), ((n, tasks[n]) for n in todo)):
            if isinstance(rows, Lost):
                lost[number] = rows.reason
                continue
            write_json(_path(folder, number), {"schema": "optshape/sweep-task/1", "task": number, "rows": rows})
            finished += 1
            if progress is not None:
                progress(finished, len(tasks))
    if lost:
        number, reason = next(iter(lost.items()))
        raise EstimationError(
            f"{folder}: {len(lost)} of {len(tasks)} tasks have no result, the first is {number}: {reason}; "
            "the same command tries them again"
        )
    return [row for number in range(len(tasks)) for row in _read(_path(folder, number), number)]


def _claim(folder: Path, describe: Mapping[str, Any]) -> None:
    """Mark the folder as this sweep's, or check that it is."""
    folder.mkdir(parents=True, exist_ok=True)
    manifest = folder / "sweep.json"
    document = {"schema": "optshape/sweep/1", "digest": _digest(describe), **describe}
    if not manifest.exists():
        if any(folder.glob("task-*.json")):
            raise InputError(f"{folder}: holds finished tasks, but no sweep.json that says of what")
        write_json(manifest, document)
        return
    found = read_json(manifest).value
    found = found.get("digest") if isinstance(found, dict) else None
    if found != document["digest"]:
        raise InputError(
            f"{manifest}: the folder holds another sweep (digest {found}, this one {document['digest']}); "
            "choose another folder, or remove that one"
        )


def _digest(describe: Mapping[str, Any]) -> str:
    text = json.dumps(describe, sort_keys=True, default=lambda array: array.tolist())
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _path(folder: Path, number: int) -> Path:
    return folder / f"task-{number:06d}.json"


def _read(path: Path, number: int) -> list[Row]:
    document = read_json(path).value
    if not isinstance(document, dict) or document.get("task") != number or not isinstance(document.get("rows"), list):
        raise InputError(f"{path}: is not the result of task {number}; remove it to have it done again")
    rows: list[Row] = document["rows"]
    return rows
