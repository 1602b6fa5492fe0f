"""The pool of workers that run many tasks: processes of this machine, or a Dask cluster.

A function of a plain value is applied to many. A worker that is killed costs one task one more try.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from optshape_graph.errors import InputError
from optshape_graph.runs.cluster import on_cluster
from optshape_graph.runs.processes import on_processes
from optshape_graph.runs.tasks import Lost, OneThread, in_order

__all__ = ["Lost", "OneThread", "Pool", "in_order"]

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Pool:
    """The workers that run tasks.

    Attributes:
        workers: processes on this machine; 1: this process itself.
        dask: address of a Dask scheduler whose workers are used instead.
        tls: files for TLS with that scheduler: the authority's certificate, the own certificate, the own key.

    Raises:
        InputError: fewer than one worker.
    """

    workers: int = 1
    dask: str | None = None
    tls: tuple[Path, Path, Path] | None = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InputError(f"expected at least one worker, found {self.workers}")

    def run(self, function: Callable[[T], R], tasks: Iterable[tuple[int, T]]) -> Iterator[tuple[int, R | Lost]]:
        """Apply a function to tasks, and yield number and result of each as it is finished.

        Args:
            function: importable by name, so that another process finds it.
            tasks: with their numbers; they are taken a few at a time.

        Raises:
            InputError: no scheduler answers.
            MissingExtraError: Dask is asked for, and absent.
            OptshapeError: workers cannot be started.
        """
        if self.dask is not None:
            return on_cluster(function, tasks, self.dask, self.tls)
        if self.workers == 1:
            return ((number, function(task)) for number, task in tasks)
        return on_processes(function, tasks, self.workers)
