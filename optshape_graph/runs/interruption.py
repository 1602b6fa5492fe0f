"""SIGINT, SIGTERM and SIGHUP as an exception, so that what is finished is kept and workers are ended."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SECONDS = 1.0
"""That may pass between a signal and the end of the process, whatever it was doing."""


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


def stop_on_signals() -> None:
    """Raise `Stopped` in the main thread at the first signal; end the process soon after, and at the second at once."""
    if threading.current_thread() is not threading.main_thread():
        return  # only the main thread can have handlers: whoever runs this in another has their own
    seen: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        if seen:
            os._exit(128 + number)
        seen.append(number)
        last = threading.Timer(SECONDS, os._exit, [128 + number])
        last.daemon = True
        last.start()
        raise Stopped(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup, and jobs in the background
            signal.signal(number, stop)


@contextmanager
def going_on(advice: Callable[[], str]) -> Iterator[None]:
    """Add to a `Stopped` that passes what is kept, and how to go on.

    Args:
        advice: returns a sentence, when it is asked for.
    """
    try:
        yield
    except Stopped as stopped:
        stopped.advice = stopped.advice or advice()
        raise
