"""Many independent tasks, on processes or a cluster, that survive being killed.

Every task is a plain value, its result plain rows. The results are the same whatever runs them: a task draws from its
own seed and computes on one thread, and the table is put together in the order of the tasks. A finished task is a file,
written whole or not at all, so a sweep that was killed goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

from optshape_graph.errors import InputError, missing_extra
from optshape_graph.io.documents import read_json, write_json

Row = dict[str, Any]
Progress = Callable[[int, int], None]
"""Called with the number of finished tasks and that of all tasks."""

T = TypeVar("T")

SCHEDULER_TIMEOUT_S = 10
"""How long to wait for a Dask scheduler to answer."""


class _OneThread(Generic[T]):
    """A task's function on one thread of linear algebra: the sum of a product depends on how it is split."""

    def __init__(self, function: Callable[[T], list[Row]]) -> None:
        self.function = function

    def __call__(self, number: int, task: T) -> tuple[int, list[Row]]:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1):
            return number, self.function(task)


def run_tasks(
    function: Callable[[T], list[Row]],
    tasks: Sequence[T],
    folder: str | Path,
    describe: Mapping[str, Any],
    *,
    workers: int = 1,
    dask: str | None = None,
    progress: Progress | None = None,
) -> list[Row]:
    """Run every task that is not finished yet, and return the rows of all, in the order of the tasks.

    Args:
        function: what to do with a task; importable by name, so that another process finds it. Its rows hold text,
            finite numbers, truth values and None.
        tasks: what to do it with; picklable.
        folder: where finished tasks are kept, made if it is not there. Another call with the same description takes
            them from there.
        describe: plain data that say what is run, version included: tasks of another description are not mixed in.
        workers: processes on this machine.
        dask: address of a Dask scheduler whose workers are used instead.
        progress: called when a task is finished, and once before the first.

    Raises:
        InputError: the folder holds another sweep, a damaged file, or `workers` is not positive.
        MissingExtraError: joblib or Dask is absent.
    """
    if workers < 1:
        raise InputError(f"expected at least one worker, found {workers}")
    folder = Path(folder)
    _claim(folder, {**describe, "tasks": len(tasks)})
    todo = [number for number in range(len(tasks)) if not _path(folder, number).exists()]
    finished = len(tasks) - len(todo)
    if progress is not None:
        progress(finished, len(tasks))
    if todo:
        with _parallel(workers, dask) as (parallel, delayed):
            work = _OneThread(function)
            for number, rows in parallel(delayed(work)(number, tasks[number]) for number in todo):
                write_json(_path(folder, number), {"schema": "optshape/sweep-task/1", "task": number, "rows": rows})
                finished += 1
                if progress is not None:
                    progress(finished, len(tasks))
    return [row for number in range(len(tasks)) for row in _read(_path(folder, number), number)]


@contextmanager
def _parallel(workers: int, dask: str | None) -> Iterator[tuple[Any, Any]]:
    """Joblib's Parallel, giving results as they come, on processes or on a Dask cluster."""
    try:
        import joblib
    except ImportError as cause:
        raise missing_extra("joblib", "evaluate", cause) from cause
    with ExitStack() as stack:
        if dask is None:
            stack.enter_context(joblib.parallel_config(backend="loky", n_jobs=workers, inner_max_num_threads=1))
        else:
            try:
                from distributed import Client
            except ImportError as cause:
                raise missing_extra("distributed", "dask", cause) from cause
            try:
                stack.enter_context(Client(dask, timeout=SCHEDULER_TIMEOUT_S))  # type: ignore[no-untyped-call]  # no stubs
            except (OSError, ValueError) as error:
                raise InputError(f"no Dask scheduler answers at {dask} ({error})") from error
            stack.enter_context(joblib.parallel_config(backend="dask", n_jobs=-1))
        yield joblib.Parallel(return_as="generator_unordered"), joblib.delayed


def _claim(folder: Path, describe: Mapping[str, Any]) -> None:
    """Make the folder this sweep's own, or find that it is."""
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
