"""SIGINT, SIGTERM and SIGHUP as an exception, so that what is finished is kept and workers are ended.

Python calls a handler between two of its own instructions, which a library's long computation keeps it from. So a
thread watches as well: whatever the process was doing, it says its line and ends `SECONDS` after a signal.
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
"""That may pass between a signal and the end of the process, whatever it was doing."""

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_advices: list[Callable[[], str]] = []
"""What is kept, and how to go on, by what runs: the innermost is last."""

_seen: list[Stopped] = []
"""What was raised in this run, if anything."""

_line = threading.Lock()
"""Taken by who says that the process was stopped: it is said once."""


class Stopped(BaseException):
    """The process was asked to end.

    Attributes:
        signal: that asked.
        advice: what is kept, and how to go on; empty: nothing was begun that could go on.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = signal.Signals(number)
        self.advice = ""

    @property
    def exit_status(self) -> int:
        """What shells expect: 130 after SIGINT, 143 after SIGTERM."""
        return 128 + self.signal


def end_on_signals() -> None:
    """End at a signal with one line and nothing else: while a command starts, and when it has ended."""
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
def whatever_becomes_of_it() -> Iterator[None]:
    """Raise `Stopped` in place of what became of it: native code that it passes turns it into errors of its own."""
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
    """Add to a `Stopped` that passes what is kept, and how to go on.

    Args:
        advice: returns a sentence, when it is asked for.
    """
    _advices.append(advice)
    try:
        yield
    except BaseException as error:
        for stopped in (error, *_seen):  # which native code may have turned into an error of its own
            if isinstance(stopped, Stopped):
                stopped.advice = stopped.advice or advice()
        raise
    finally:
        _advices.remove(advice)


def first_to_say() -> bool:
    """Whether nobody has said yet that the process was stopped; who asks has to say it."""
    return _line.acquire(blocking=False)


def stopped_line(number: int, advice: str) -> str:
    """Return the line that says by which signal the process was stopped, what is kept, and how to go on."""
    return f"optshape: stopped by {signal.Signals(number).name}" + (f": {advice}" if advice else "")


def _handle(handler: Callable[[int, FrameType | None], None]) -> bool:
    """Handle the signals, those apart that are ignored: under nohup, or by a job in the background."""
    if threading.current_thread() is not threading.main_thread():
        return False  # only the main thread can have handlers: who runs this in another has their own
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
    return True


def _stop(number: int, frame: FrameType | None) -> None:
    """Raise at the first signal; of a second one the watcher ends the process."""
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
    """Wait until time is over, or for another signal."""
    import select

    deadline = time.monotonic() + SECONDS
    while (left := deadline - time.monotonic()) > 0:
        if select.select([reader], [], [], left)[0] and os.read(reader, 1)[0] in SIGNALS:
            return


def _end(number: int, frame: FrameType | None) -> None:
    """Say why, and end without a word more from anything that runs."""
    if first_to_say():
        advice = _seen[0].advice if _seen else ""
        with suppress(Exception):
            advice = advice or (_advices[-1]() if _advices else "")
        with suppress(OSError):
            os.write(2, (shown(stopped_line(number, advice)) + "\n").encode(errors="backslashreplace"))
    os._exit(128 + number)


def _unraisable(unraisable: sys.UnraisableHookArgs) -> None:
    """Say nothing of a `Stopped` that was raised where nothing can be: the watcher ends the process."""
    if not issubclass(unraisable.exc_type, Stopped):
        sys.__unraisablehook__(unraisable)
