"""Streams of stamped values in order of time, what cannot be used being counted; pairs of values of two streams."""

from __future__ import annotations

import logging
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Generic, TypeVar

import numpy as np

from optshape_graph._arrays import Floats, Ints

T = TypeVar("T")

LOOKAHEAD = 8
"""Number of following stamps that decide whether a stamp is in order."""

SETTLED = 4
"""So many following stamps tell whether the clock was set back, or one message is late."""

SET_BACK = 1.0
"""A clock is followed if it was set by at least so many seconds, on which topics of different rates agree."""

AGREE = 0.5
"""Seconds by which the ways of messages to the recorder may differ, if its clock is to tell of a jump."""

ROUNDING = 1e-6
"""Seconds since 1970 as 64-bit floats are rounded to a quarter of this."""

log = logging.getLogger(__name__)


class BadMessage(Exception):  # noqa: N818 - it is caught where it is counted, and never leaves this package
    """A message that cannot be used.

    Attributes:
        reason: a few words without numbers, by which messages are counted.
        detail: what was found in this message, for the log.
    """

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(f"{reason}: {detail}" if detail else reason)
        self.reason = reason
        self.detail = detail


@dataclass(frozen=True)
class Stamped(Generic[T]):
    """A value and the time at which it was measured.

    Attributes:
        stamp: seconds, of the clock that stamped the message's header.
        value: what was measured.
        received: seconds, of the recorder's clock, when the message came; None: not recorded.
    """

    stamp: float
    value: T
    received: float | None = None


class Skipped(Counter[str]):
    """Number of skipped messages by reason.

    Attributes:
        examples: what was found in the first message of each reason.
        unused: number of messages that had a field which is not used, by its name.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.examples: dict[str, str] = {}
        self.unused: Counter[str] = Counter()

    def add(self, problem: BadMessage, where: str, count: int = 1) -> None:
        """Count a message that was skipped, and log it."""
        log.info("%s: skipped: %s", where, problem)
        self[problem.reason] += count
        self.examples.setdefault(problem.reason, problem.detail)

    def __str__(self) -> str:
        """Return all reasons in one line, with the first example of each."""
        said = (f"{count} x {reason} ({self.examples.get(reason, '')})" for reason, count in self.items())
        return ", ".join(said) or "nothing skipped"


@dataclass(frozen=True)
class Jump:
    """A jump of a clock that was set during the recording.

    Attributes:
        stamp: the time before, seconds.
        seconds: by how much the clock was set back; negative: forward.
    """

    stamp: float
    seconds: float


class Stream(Generic[T]):
    """Stamped values in order of time, read one by one while it is iterated.

    Every iteration starts over and holds its own file handle, so several streams of one recording can be
    read side by side. Stamps increase strictly.

    Attributes:
        name: the file and topic, for messages.
        expected: number of messages that the recording states, or None.
        follow: whether a clock that was set is followed: later stamps are made those of the clock before. Otherwise
            messages are skipped until the clock shows later times again, and stamps that it was set forward stay.
        skipped: number of messages skipped by reason, of the latest iteration.
        jumps: jumps of the clock that were followed, of the latest iteration.
    """

    def __init__(
        self,
        name: str,
        read: Callable[[Skipped], Iterator[Stamped[T]]],
        expected: int | None = None,
        follow: bool = False,
    ) -> None:
        self.name = name
        self.expected = expected
        self.follow = follow
        self.skipped = Skipped()
        self.jumps: list[Jump] = []
        self._read = read

    def __iter__(self) -> Iterator[Stamped[T]]:
        self.skipped, self.jumps = Skipped(), []
        items = self._read(self.skipped)
        return in_order(followed(items, self.jumps) if self.follow else items, self.skipped, self.name)

    def following(self) -> Stream[T]:
        """Return the same stream, with a clock that was set followed."""
        return Stream(self.name, self._read, self.expected, follow=True)


def followed(items: Iterable[Stamped[T]], jumps: list[Jump]) -> Iterator[Stamped[T]]:
    """Yield the items, stamped as if their clock had gone on by its usual step instead of being set.

    The clock was set back where a stamp, and those after it in order, lie a second or more before the latest one. It
    was set forward where they lie a second or more after it and, by the recorder's clock, should not: by stamps alone
    a pause looks the same.

    Args:
        items: in the order of recording.
        jumps: a list to which the followed jumps are added.
    """
    window: deque[Stamped[T]] = deque()
    recent: deque[Stamped[T]] = deque(maxlen=LOOKAHEAD + 1)  # as they were yielded
    shift = 0.0

    def shifted(item: Stamped[T]) -> Stamped[T]:
        return Stamped(item.stamp + shift, item.value, item.received) if shift else item

    def settle() -> Stamped[T]:
        nonlocal shift
        item = window.popleft()
        run = [shifted(one) for one in (item, *window)]
        if len(recent) > SETTLED and len(run) > SETTLED and all(a.stamp < b.stamp for a, b in pairwise(run)):
            back = _set_back(list(recent), run)
            if back is not None:
                jumps.append(Jump(max(one.stamp for one in recent if one.stamp < run[0].stamp + back) - shift, back))
                shift += back
                recent.clear()
        recent.append(shifted(item))
        return recent[-1]

    for item in items:
        window.append(item)
        if len(window) > LOOKAHEAD:
            yield settle()
    while window:
        yield settle()


def _set_back(before: Sequence[Stamped[T]], run: Sequence[Stamped[T]]) -> float | None:
    """By how many seconds a clock was set back between some messages and those that follow; None: it was not set."""
    stamps = [one.stamp for one in before]
    step = float(np.median(np.diff(stamps)))
    last = max((one for one in before if one.stamp <= np.median(stamps) + LOOKAHEAD * step), key=lambda one: one.stamp)
    back = last.stamp + step - run[0].stamp
    if run[SETTLED].stamp <= last.stamp and back >= SET_BACK:
        return back
    ahead = [
        np.array([np.nan if one.received is None else one.stamp - one.received for one in some])
        for some in (before, run[: SETTLED + 1])
    ]
    if all(np.ptp(some) < AGREE for some in ahead) and np.median(ahead[1]) - np.median(ahead[0]) >= SET_BACK:
        assert last.received is not None  # else it would not be a number
        assert run[0].received is not None
        steps = max(round((run[0].received - last.received) / step), 1)
        return back + (steps - 1) * step
    return None


def in_order(items: Iterable[Stamped[T]], skipped: Skipped, where: str) -> Iterator[Stamped[T]]:
    """Yield the items whose stamps increase strictly, leaving out as few as possible.

    A message with a stamp in the far future must not make all later messages look late. So a message is kept if the
    longest increasing run of stamps, among it and the next `LOOKAHEAD`, is no shorter with it than without it.
    """
    last = float("-inf")
    window: deque[Stamped[T]] = deque()

    def settle() -> Iterator[Stamped[T]]:
        nonlocal last
        item = window.popleft()
        if item.stamp == last:
            skipped.add(BadMessage("stamp duplicated", f"{item.stamp:.9f} s"), where)
        elif item.stamp < last:
            skipped.add(BadMessage("stamp goes backward", f"{item.stamp:.9f} s after {last:.9f} s"), where)
        elif _ahead_of_the_rest(item.stamp, [later.stamp for later in window], last):
            skipped.add(BadMessage("stamp ahead of those that follow", f"{item.stamp:.9f} s"), where)
        else:
            last = item.stamp
            yield item

    for item in items:
        window.append(item)
        if len(window) > LOOKAHEAD:
            yield from settle()
    while window:
        yield from settle()


def _ahead_of_the_rest(stamp: float, following: list[float], last: float) -> bool:
    """Return whether keeping `stamp` would leave out more of the following stamps than leaving it out."""
    kept = 1 + _longest_increasing(later for later in following if later > stamp)
    return kept < _longest_increasing(later for later in following if later > last)


def _longest_increasing(stamps: Iterable[float]) -> int:
    """Return the length of the longest strictly increasing subsequence (patience sorting)."""
    smallest_end: list[float] = []
    for stamp in stamps:
        k = bisect_left(smallest_end, stamp)
        smallest_end[k : k + 1] = [stamp]
    return len(smallest_end)


def nearest(stamps: Floats, others: Floats) -> Ints:
    """Return, for each of `stamps` (N,), the index of the nearest of `others` (M,), increasing and not empty."""
    after = np.searchsorted(others, stamps).clip(1, max(len(others) - 1, 1))
    if len(others) == 1:
        return np.zeros(len(stamps), dtype=np.int64)
    return np.where(stamps - others[after - 1] <= others[after] - stamps, after - 1, after)


def pair(stamps: Floats, others: Floats, tolerance: float) -> Ints:
    """Pair each stamp with the nearest of the others, if each is the other's nearest and they are not too far apart.

    Args:
        stamps: (N,) seconds, increasing.
        others: (M,) seconds, increasing, of the same clock.
        tolerance: largest difference, seconds.

    Returns:
        (N,) index into `others`, or -1. No index is there twice.
    """
    if not len(stamps) or not len(others):
        return np.full(len(stamps), -1, dtype=np.int64)
    there = nearest(stamps, others)
    back = nearest(others, stamps)
    paired = (back[there] == np.arange(len(stamps))) & (np.abs(others[there] - stamps) <= tolerance)
    return np.where(paired, there, -1)


def spaced(stamps: Floats, interval: float) -> np.ndarray:
    """Return (N,) whether to keep each stamp, the first included, so that they are `interval` seconds or more apart."""
    keep = np.zeros(len(stamps), dtype=bool)
    last = -np.inf
    for k, stamp in enumerate(stamps):
        keep[k] = stamp - last >= interval - ROUNDING
        last = stamp if keep[k] else last
    return keep
