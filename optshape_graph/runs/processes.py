"""Tasks on processes of this machine; a worker that is killed costs one task one more try.

Each worker has one task at a time, so that it is known which task a dead worker had; it is tried once more on a new
worker, then reported as `Lost`. Workers end with the process that started them, however that ends.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from optshape_graph.errors import OptshapeError
from optshape_graph.runs.interruption import SIGNALS
from optshape_graph.runs.tasks import Lost

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

T = TypeVar("T")
R = TypeVar("R")

MOST_DEATHS = 20
"""So many workers in a row may end before they begin; one more is an error."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that keep linear algebra on one thread, so that results do not depend on the pool."""


def on_processes(
    function: Callable[[T], R], tasks: Iterable[tuple[int, T]], workers: int
) -> Iterator[tuple[int, R | Lost]]:
    """Apply a function to numbered tasks on as many processes, and yield number and result of each as it is finished.

    Raises:
        OptshapeError: workers cannot be started. What the function raises is raised, too.
    """
    from multiprocessing import connection

    queue = _Queue(tasks)
    pool: list[_Worker[T, R]] = []
    died = 0  # workers in a row that ended before they could begin
    try:
        while queue.has_more() or any(worker.task for worker in pool):
            if len(pool) < workers and queue.has_more() and all(worker.task or not worker.ready for worker in pool):
                pool.append(_Worker(function))
            for worker in pool:
                if worker.ready and worker.task is None:
                    worker.give(queue.next())
            if len(pool) < workers and queue.has_more():
                continue
            waited = {worker.pipe: worker for worker in pool if worker.task or not worker.ready}
            for pipe in connection.wait(list(waited)):
                worker = waited[pipe]  # type: ignore[index]  # it is one of those that were given
                entry, reply = worker.task, worker.reply()
                worker.task = None
                if reply is None:
                    how = worker.restart()
                    died += entry is None
                    if died > MOST_DEATHS:
                        raise OptshapeError(f"workers end before they begin ({how}); --workers 1 does without them")
                    if entry is not None and not queue.put_back(*entry):
                        yield entry[0], Lost(f"its worker was killed twice ({how})")
                elif entry is None:
                    worker.ready, died = True, 0
                else:
                    worker.give(queue.next())
                    returned, result = reply
                    if not returned:
                        raise result
                    yield entry[0], result
    finally:
        for worker in pool:
            worker.end()


class _Queue(Generic[T]):
    """Tasks to hand out: new ones, and those whose worker was killed."""

    def __init__(self, tasks: Iterable[tuple[int, T]]) -> None:
        self._new, self._again, self._lost = iter(tasks), list[tuple[int, T]](), set[int]()

    def next(self) -> tuple[int, T] | None:
        """Take a task; None: there are no more."""
        if not self._again and (new := next(self._new, None)) is not None:
            self._again.append(new)
        return self._again.pop() if self._again else None

    def has_more(self) -> bool:
        """Return whether there is a task to hand out."""
        if (task := self.next()) is not None:
            self._again.append(task)
        return task is not None

    def put_back(self, number: int, task: T) -> bool:
        """Put back a task whose worker was killed; return False, and leave it out, if that happened before."""
        if number in self._lost:
            return False
        self._lost.add(number)
        self._again.append((number, task))
        return True


class _Worker(Generic[T, R]):
    """A process that applies the function, and the task that it has; None: it waits for a task."""

    def __init__(self, function: Callable[[T], R]) -> None:
        self.task: tuple[int, T] | None = None
        self._function = function
        self.ready = False  # until it reports that it has loaded all it needs
        self._start()

    def give(self, task: tuple[int, T] | None) -> None:
        self.task = task
        if task is not None:
            with suppress(OSError):  # it is dead: found out when its result is waited for
                self.pipe.send(task[1])

    def reply(self) -> tuple[bool, Any] | None:
        """Return whether the task's function returned, and what it returned or raised; None: the process is dead."""
        try:
            said: tuple[bool, Any] = self.pipe.recv()
        except (EOFError, OSError):
            return None
        return said

    def restart(self) -> str:
        """Start a new process in place of a dead one; return how the dead one ended."""
        self.end()
        code = self._process.exitcode
        self.ready = False
        self._start()
        return f"signal {-code}" if code is not None and code < 0 else f"exit status {code}"

    def end(self) -> None:
        self.pipe.close()
        self._process.kill()
        self._process.join()

    def _start(self) -> None:
        """Spawn a process; a fork would copy the locks of whatever threads the caller runs."""
        from multiprocessing import get_context

        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._function), daemon=True)
        with _one_thread_for_children(), _signals_later():
            self._process.start()
        theirs.close()


@contextmanager
def _one_thread_for_children() -> Iterator[None]:
    """Keep the linear algebra of processes that start meanwhile on one thread."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _signals_later() -> Iterator[None]:
    """Hold back signals meanwhile, here and in processes that start; these take theirs when they have begun."""
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # it lets signals through when it is started
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(pipe: Connection, function: Callable[[Any], Any]) -> None:
    """Do tasks until there are no more; end when the process that started this one has ended."""
    for number in SIGNALS:  # a terminal sends SIGINT to all, and the parent decides
        signal.signal(number, signal.SIG_IGN if number == signal.SIGINT else signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):
        pipe.send((True, None))  # all that the function needs is loaded
        while True:
            task = pipe.recv()
            try:
                result = True, function(task)
            except Exception as error:
                result = False, _sendable(error)
            pipe.send(result)


def _end_with_parent() -> None:
    from multiprocessing import connection, parent_process

    parent = parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)


def _sendable(error: Exception) -> Exception:
    """Return an error that can be pickled: this one, or its text."""
    import pickle

    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
