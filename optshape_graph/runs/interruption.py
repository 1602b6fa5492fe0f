"""SIGINT, SIGTERM and SIGHUP as an exception, so that finished tasks are kept and workers are ended.

Python calls a handler between two of its own instructions, so a long computation in a library delays it. Therefore a
thread watches, too: it prints the line and ends the process `SECONDS` after a signal, whatever the process is doing.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from optshape_graph.names import shown

SECONDS = 1.0
"""Seconds between a signal and the end of the process, at most."""

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_advices: list[Callable[[], str]] = []
"""Functions that return what is kept and how to go on, of each running block; the innermost is last."""

_seen: list[Stopped] = []
"""The exception that was raised in this run, if any."""

_line = threading.Lock()
"""Taken by the first to print that the process was stopped, so that it is printed once."""


class Stopped(BaseException):
    """The process was asked to end.

    Attributes:
        signal: number of the signal.
        advice: what is kept, and how to go on; empty: nothing can go on.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = signal.Signals(number)
        self.advice = ""

    @property
    def exit_status(self) -> int:
        """Exit status that shells expect: 130 after SIGINT, 143 after SIGTERM."""
        return 128 + self.signal


def end_on_signals() -> None:
    """End at a signal with one line, while a command starts and after it has ended."""
    _handle(_end)


def stop_on_signals() -> None:
    """Raise `Stopped` in the main thread at the first signal; end the process soon after, and at the second at once."""
    if not _handle(_stop):
        return
    _seen.clear()
    if _line.locked():
        _line.release()
    if sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _unraisable
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    if before >= 0:  # an earlier run in this process; its watcher ends
        os.close(before)
    threading.Thread(target=_watch, args=(reader,), daemon=True).start()


@contextmanager
def stopped_before_errors() -> Iterator[None]:
    """Raise `Stopped` in place of any error that native code has turned it into."""
    try:
        yield
    except Stopped:
        raise
    except BaseException:
        if _seen:
            raise _seen[0] from None
        raise


@contextmanager
def going_on(advice: Callable[[], str]) -> Iterator[None]:
    """Add to a `Stopped` from the block what is kept, and how to go on.

    Args:
        advice: returns that sentence.
    """
    _advices.append(advice)
    try:
        yield
    except BaseException as error:
        for stopped in (error, *_seen):  # native code may have turned it into another error
            if isinstance(stopped, Stopped):
                stopped.advice = stopped.advice or advice()
        raise
    finally:
        _advices.remove(advice)


def is_first_to_report() -> bool:
    """Return whether nobody has printed yet that the process was stopped; then the caller must print it."""
    return _line.acquire(blocking=False)


def stopped_line(number: int, advice: str) -> str:
    """Return the line with the signal that stopped the process, what is kept, and how to go on."""
    return f"optshape: stopped by {signal.Signals(number).name}" + (f": {advice}" if advice else "")


def _handle(handler: Callable[[int, FrameType | None], None]) -> bool:
    """Set the handler of the signals, except of those that are ignored, as under nohup or in a background job."""
    if threading.current_thread() is not threading.main_thread():
        return False  # only the main thread can have handlers
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
    return True


def _stop(number: int, frame: FrameType | None) -> None:
    """Raise at the first signal; at a second one the watcher ends the process."""
    _handle(_stopping)
    _seen.append(Stopped(number))
    raise _seen[0]


def _stopping(number: int, frame: FrameType | None) -> None:
    """Do nothing: the process is about to end."""


def _watch(reader: int) -> None:
    """Wait for a signal; end the process some time after it."""
    while read := os.read(reader, 1):
        number = read[0]
        if number in SIGNALS and signal.getsignal(number) in (_stop, _stopping):
            _await_second(reader)
            _end(number, None)
    os.close(reader)


def _await_second(reader: int) -> None:
    """Wait until the time is over, or for another signal."""
    import select

    deadline = time.monotonic() + SECONDS
    while (left := deadline - time.monotonic()) > 0:
        if select.select([reader], [], [], left)[0] and os.read(reader, 1)[0] in SIGNALS:
            return


def _end(number: int, frame: FrameType | None) -> None:
    """Print why, and end the process with no further output."""
    if is_first_to_report():
        advice = _seen[0].advice if _seen else ""
        with suppress(Exception):
            advice = advice or (_advices[-1]() if _advices else "")
        with suppress(OSError):
            os.write(2, (shown(stopped_line(number, advice)) + "\n").encode(errors="backslashreplace"))
    os._exit(128 + number)


def _unraisable(unraisable: sys.UnraisableHookArgs) -> None:
    """Ignore a `Stopped` where no exception can be raised: the watcher ends the process."""
    if not issubclass(unraisable.exc_type, Stopped):
        sys.__unraisablehook__(unraisable)
