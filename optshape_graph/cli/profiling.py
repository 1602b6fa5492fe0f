"""The time of a run: by room of the package, and by function."""

from __future__ import annotations

import contextlib
import cProfile
import pstats
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from optshape_graph.cli.console import print_table, say

PACKAGE = Path(__file__).resolve().parents[1]

SHOWN = 12
"""Functions that are shown, those with the most time of their own first."""

PASSES = 60
"""Depth to which calls among libraries are followed back to the function of the package that made them."""

Function = tuple[str, int, str]
"""File, line and name, as the profiler gives them."""


def room_of(function: Function) -> str | None:
    """Return the room of the package that a function is in; None: it is outside the package."""
    file, _, _ = function
    if "importlib" in file:
        return "imports"
    path = Path(file)
    if not path.is_relative_to(PACKAGE):
        return None
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else "nouns"


def time_by_room(calls: Mapping[Function, tuple[Any, ...]]) -> dict[str, float]:
    """Return the seconds that each room took, including the libraries that it called.

    The time of functions outside the package is charged to their callers, in proportion to the time spent for each.

    Args:
        calls: for each function, as in `pstats.Stats.stats`: calls, all calls, own seconds, seconds, and the same by
            caller.
    """
    rooms: dict[str, float] = defaultdict(float)
    waiting: dict[Function, float] = {}
    for function, (_, _, own, _, _) in calls.items():
        room = room_of(function)
        if room is None:
            waiting[function] = own
        else:
            rooms[room] += own
    for _ in range(PASSES):
        charged: dict[Function, float] = defaultdict(float)
        for function, seconds in waiting.items():
            callers = calls[function][4]
            total = sum(by[3] for by in callers.values())
            if not total:
                rooms["other"] += seconds
                continue
            for caller, by in callers.items():
                room, share = room_of(caller), seconds * by[3] / total
                if room is not None:
                    rooms[room] += share
                elif caller in calls:
                    charged[caller] += share
        waiting = charged
    rooms["other"] += sum(waiting.values())
    return dict(sorted(rooms.items(), key=lambda item: -item[1]))


@contextlib.contextmanager
def profiled() -> Iterator[None]:
    """Print where the time of the block went, however the block ends."""
    profiler = cProfile.Profile()
    profiler.enable()
    try:
        yield
    finally:
        profiler.disable()
        print_profile(profiler)


def print_profile(profiler: cProfile.Profile) -> None:
    """Print where the time went, to standard error: tables of rooms and of functions."""
    stats: Any = pstats.Stats(profiler)
    calls, total = stats.stats, max(stats.total_tt, 1e-9)
    rooms = [[room, f"{t:.2f}", f"{t / total:.0%}"] for room, t in time_by_room(calls).items() if t >= 0.005 * total]
    say(f"The run took {total:.2f} s. By room of the package, with the libraries that each calls:", err=True)
    print_table("", ["room", "s", "share"], rooms, err=True)
    dearest = sorted(calls.items(), key=lambda item: -item[1][2])[:SHOWN]
    rows = [[_named(function), f"{own:.2f}", f"{whole:.2f}", f"{n}"] for function, (_, n, own, whole, _) in dearest]
    say("By function, those with the most time of their own first:", err=True)
    print_table("", ["function", "own s", "with what it calls, s", "calls"], rows, err=True)
    say("The profiler makes small functions look up to twice as slow. Workers are not in it: --workers 1.", err=True)


def _named(function: Function) -> str:
    file, line, name = function
    if file == "~":
        return name.strip("<>")
    path = Path(file)
    where = path.relative_to(PACKAGE) if path.is_relative_to(PACKAGE) else Path(*path.parts[-2:])
    return f"{where}:{line} {name}"
