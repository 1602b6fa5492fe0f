"""The unit of a time that is counted from 1970, told by its size."""

from __future__ import annotations

TICKS = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3))
"""A time from here on counts this many units a second: as seconds it would be after the year 5000."""


def ticks_per_second(time: float) -> float:
    """Return 1e9, 1e6, 1e3 or 1: whether an epoch time is in ns, us, ms or s. What is smaller is in seconds."""
    return next((ticks for smallest, ticks in TICKS if abs(time) >= smallest), 1.0)
