"""Tasks on processes of this machine or on a Dask cluster; a worker that is killed costs one task one more try.

A function of a plain value is applied to many. On processes each worker has one task at a time, so that it is known
which task a dead worker had; it is tried once more on a new worker, then reported as `Lost`. Workers end with the
process that started them, however that ends.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from optshape_graph.errors import InputError, OptshapeError, missing_extra
from optshape_graph.io.files import read_head
from optshape_graph.runs.interruption import SIGNALS

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

T = TypeVar("T")
R = TypeVar("R")

SCHEDULER_TIMEOUT_S = 10
"""How long to wait for a Dask scheduler to answer."""

AHEAD = 3
"""Tasks for each worker of a cluster that are handed out: more would only take memory."""

MOST_DEATHS = 20
"""Workers in a row that may end before they begin."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables that keep linear algebra on one thread: results do not depend on the number of workers."""


@dataclass(frozen=True)
class Lost:
    """What stands for the result of a task whose worker was killed twice.

    Attributes:
        reason: in words.
    """

    reason: str


@dataclass(frozen=True)
class Pool:
    """What runs the tasks.

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
            return _on_cluster(function, tasks, self.dask, self.tls)
        if self.workers == 1:
            return ((number, function(task)) for number, task in tasks)
        return _on_processes(function, tasks, self.workers)


def in_order(results: Iterable[tuple[int, R]], first: int = 0) -> Iterator[R]:
    """Yield results that come with their numbers, in any order, in the order of the numbers.

    Args:
        results: numbers `first`, `first` + 1, ... with what belongs to them.
        first: the lowest number.
    """
    waiting: dict[int, R] = {}
    for number, result in results:
        waiting[number] = result
        while first in waiting:
            yield waiting.pop(first)
            first += 1


class _Queue(Generic[T]):
    """Tasks that are to be given out: new ones, and those whose worker was killed."""

    def __init__(self, tasks: Iterable[tuple[int, T]]) -> None:
        self._new, self._again, self._lost = iter(tasks), list[tuple[int, T]](), set[int]()

    def next(self) -> tuple[int, T] | None:
        """Take a task; None: there are no more."""
        if not self._again and (new := next(self._new, None)) is not None:
            self._again.append(new)
        return self._again.pop() if self._again else None

    def has_more(self) -> bool:
        """Whether there is a task that nobody has."""
        if (task := self.next()) is not None:
            self._again.append(task)
        return task is not None

    def is_tried_again(self, number: int, task: T) -> bool:
        """Put back a task whose worker was killed, unless that happened before."""
        if number in self._lost:
            return False
        self._lost.add(number)
        self._again.append((number, task))
        return True


class _Worker(Generic[T, R]):
    """A process that applies the function, and the task that it has; None: it waits for one."""

    def __init__(self, function: Callable[[T], R]) -> None:
        self.task: tuple[int, T] | None = None
        self._function = function
        self.ready = False  # until it says that it has loaded all it needs
        self._start()

    def give(self, task: tuple[int, T] | None) -> None:
        self.task = task
        if task is not None:
            with suppress(OSError):  # it is dead: found out when its result is waited for
                self.pipe.send(task[1])

    def reply(self) -> tuple[bool, Any] | None:
        """Whether the task's function returned, and what it returned or raised; None: the process is dead."""
        try:
            said: tuple[bool, Any] = self.pipe.recv()
        except (EOFError, OSError):
            return None
        return said

    def restart(self) -> str:
        """Start a new process in place of a dead one; return how that ended."""
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
        """Spawned, not forked: a fork copies the locks of whatever threads the caller runs."""
        from multiprocessing import get_context

        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._function), daemon=True)
        with _one_thread_for_children(), _signals_later():
            self._process.start()
        theirs.close()


def _on_processes(
    function: Callable[[T], R], tasks: Iterable[tuple[int, T]], workers: int
) -> Iterator[tuple[int, R | Lost]]:
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
                    if entry is not None and not queue.is_tried_again(*entry):
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


@contextmanager
def _one_thread_for_children() -> Iterator[None]:
    """Keep the linear algebra of processes that are started meanwhile on one thread."""
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
    """Hold back signals, here and in processes that are started meanwhile: these take theirs when they have begun."""
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
    """Return an error that survives a pickle."""
    import pickle

    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _on_cluster(
    function: Callable[[T], R], tasks: Iterable[tuple[int, T]], address: str, tls: tuple[Path, Path, Path] | None
) -> Iterator[tuple[int, R | Lost]]:
    try:
        from distributed import Client, KilledWorker, Security, as_completed
    except ImportError as cause:
        raise missing_extra("distributed", "dask", cause) from cause
    if tls is not None:
        _check_certificates(*tls)
    _check_reachable(address)
    security: dict[str, Any] = {}
    if tls is not None:
        authority, certificate, key = map(str, tls)
        security["security"] = Security(
            tls_ca_file=authority, tls_client_cert=certificate, tls_client_key=key, require_encryption=True
        )
    try:
        client = Client(address, timeout=SCHEDULER_TIMEOUT_S, **security)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"no Dask scheduler answers at {address} ({error})") from error
    with client:
        remaining, numbers = iter(tasks), dict[Any, int]()
        finished = as_completed(raise_errors=False)

        def submit() -> None:
            task = next(remaining, None)
            if task is not None:
                future = client.submit(OneThread(function), task[1], pure=False, retries=1)
                numbers[future.key] = task[0]
                finished.add(future)

        threads = sum(client.nthreads().values()) or 1
        for _ in range(AHEAD * threads):
            submit()
        for future in finished:
            number, failure = numbers.pop(future.key), future.exception()
            submit()
            if isinstance(failure, KilledWorker):
                yield number, Lost(f"its worker was killed ({failure})")
            elif failure is not None:
                raise failure
            else:
                yield number, future.result()


def _check_certificates(authority: Path, certificate: Path, key: Path) -> None:
    """Read the files for TLS, so that an error names the one that is wrong.

    Raises:
        InputError: they are no certificates and key in PEM, the key is another's, or a password locks it.
    """
    import ssl

    for path in (authority, certificate, key):
        read_head(path, 1)  # missing, or not to be read
        if not path.is_file():
            raise InputError(f"{path}: expected a file")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(authority)
    except OSError as error:
        raise InputError(f"{authority}: expected the certificate of an authority, in PEM ({error})") from error
    try:
        context.load_cert_chain(certificate, key, password="")  # else it is asked for, on the terminal
    except OSError as error:
        raise InputError(
            f"{certificate}, {key}: expected a certificate and its own key without password, in PEM ({error})"
        ) from error


def _check_reachable(address: str) -> None:
    """Find out before a client is made, which waits and tries again, that nothing listens at an address.

    Raises:
        InputError: it is no address, or nothing listens there.
    """
    import re
    import socket

    found = re.fullmatch(r"(?:(?:tcp|tls)://)?(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]{1,253}):([0-9]{1,5})", address)
    if found is None or int(found[2]) > 65535:
        raise InputError(
            f"expected the address of a scheduler, as tcp://HOST:PORT or tls://HOST:PORT; found '{address}'"
        )
    try:
        socket.create_connection((found[1].strip("[]"), int(found[2])), SCHEDULER_TIMEOUT_S).close()
    except (OSError, UnicodeError) as error:
        raise InputError(f"no Dask scheduler answers at {address} ({error})") from error


class OneThread(Generic[T, R]):
    """A function on one thread of linear algebra: the sum of a product depends on how it is split.

    Args:
        function: of a task.
    """

    def __init__(self, function: Callable[[T], R]) -> None:
        self.function = function

    def __call__(self, task: T) -> R:
        try:
            from threadpoolctl import threadpool_limits
        except ImportError:  # without the extra `evaluate`
            return self.function(task)
        with threadpool_limits(1):
            return self.function(task)
