"""Times of unknown units: since 1970 the size of the number tells the unit, otherwise the duration of the scan."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Floats

TICKS = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3))
"""Pairs: a time of at least the first number has the second number of units a second; as seconds it would be after
5000."""

EPOCH_S = 1e9
"""Seconds since 1970 exceed this (2001)."""

LONGEST_SCAN_S = 10.0
"""A scan is shorter; times that would make it longer are in a smaller unit."""

REVOLUTION_S = (0.02, 1.2)
"""Seconds that a revolution takes, from the fastest to the slowest spinning LiDAR: 50 to 0.8 Hz."""

LEAST_SWEEP = np.radians(1.0)
"""Azimuth that a scan must sweep to tell how long a revolution takes, rad."""

AZIMUTH_BIN = np.radians(0.05)
"""Width of the bins in which azimuths are counted, rad."""

_UNITS = (1.0, 1e-3, 1e-6, 1e-9)


def ticks_per_second(time: float) -> float:
    """Return 1e9, 1e6, 1e3 or 1 for a time in ns, us, ms or s since 1970; a smaller number counts as seconds."""
    return next((ticks for smallest, ticks in TICKS if abs(time) >= smallest), 1.0)


def parse_stamp(word: str) -> float | None:
    """Return a stamp in seconds from a word with seconds, with ms, us or ns since 1970, or with a date.

    A date without a time zone is UTC. None: the word is not a stamp.
    """
    try:
        value = float(word)
    except ValueError:
        return _date(word)
    if not abs(value) < 1e20:
        return None
    if word.isdecimal() and ticks_per_second(value) > 1:  # as integers, since a float would lose nanoseconds
        ticks = int(ticks_per_second(value))
        whole, part = divmod(int(word), ticks)
        return whole + part / ticks
    return value / ticks_per_second(value)


def _date(word: str) -> float | None:
    try:
        date = datetime.fromisoformat(word)
    except ValueError:
        return None
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp() if "-" in word else None


def seconds_of_points(
    time: NDArray[Any], unit: float | None, stamp: float | None, points: Floats | None
) -> Floats | None:
    """Return per-point times (N,) as seconds (N,) relative to the scan's stamp; None: the numbers are not times.

    - Times since 1970 show their unit by their size: about 1e18 are nanoseconds, 1e15 microseconds, 1e12 milliseconds,
      and 1e9, as floats, seconds. They are counted from `stamp`, or from the earliest.
    - Smaller numbers are relative to the stamp. If `unit` is None, integers are nanoseconds, as Ouster's and Livox's
      drivers write them. Floats are in the largest of seconds, milli-, micro- and nanoseconds in which the scan lasts
      no more than `LONGEST_SCAN_S`; but if a revolution would take impossibly long or short in it (`REVOLUTION_S`), and
      a possible time in exactly one other unit, they are in that one.
    - Relative times that are far from the stamp come from another clock; they are counted from the earliest.

    Args:
        time: (N,) of any numeric type, in `unit`, or in seconds, milli-, micro- or nanoseconds.
        unit: in seconds, if the source states it.
        stamp: the scan's, seconds since 1970, if known.
        points: (N, 3) metres, LiDAR frame, whose azimuths tell the time of a revolution; None: this test is left out.
    """
    floating = time.dtype.kind == "f"
    first, last = time.min(), time.max()
    if floating and not (first > -1e20 and last < 1e20):  # False for NaN
        return None
    duration = float(last) - float(first)
    ticks = ticks_per_second(float(first))
    epoch = first > 0 and (ticks > 1 or (floating and float(first) >= EPOCH_S)) and duration / ticks <= LONGEST_SCAN_S
    if unit is None and epoch:
        unit = 1 / ticks
    elif unit is None:
        unit = _unit_of_floats(duration, points) if floating else _UNITS[-1]
    if float(first) * unit >= EPOCH_S / 10:  # since 1970
        offset = 0.0 if stamp is None else float(first) * unit - stamp
        seconds = _scaled(time, first, unit)
        seconds += offset
        return seconds
    own_clock = abs(float(first)) * unit > LONGEST_SCAN_S
    return _scaled(time, first if own_clock else None, unit)


def _scaled(time: NDArray[Any], first: np.generic | None, unit: float) -> Floats:
    """Return times (N,) in seconds since the first. Integers are subtracted as such: a float would lose nanoseconds."""
    seconds = (time if first is None else time - first).astype(np.float64)
    if unit != 1:
        seconds *= unit
    return seconds


def _unit_of_floats(duration: float, points: Floats | None) -> float:
    """Return the largest unit in which the scan is short enough, or the only one with a possible revolution."""
    unit = next((u for u in _UNITS if duration * u <= LONGEST_SCAN_S), _UNITS[-1])
    if points is None or not duration:
        return unit
    swept = _swept(points)
    if swept < LEAST_SWEEP:
        return unit
    shortest, longest = REVOLUTION_S
    possible = [u for u in _UNITS if shortest <= duration * u * 2 * np.pi / swept <= longest]
    return unit if unit in possible or len(possible) != 1 else possible[0]


def _swept(points: Floats) -> float:
    """Return the angle, rad, that azimuths sweep, the circle less their largest gap, to within `AZIMUTH_BIN`."""
    n = round(2 * np.pi / AZIMUTH_BIN)
    azimuth = np.arctan2(points[:, 1], points[:, 0], dtype=np.float32)
    azimuth *= n / (2 * np.pi)
    seen = np.zeros(n, dtype=bool)
    seen[np.floor(azimuth, out=azimuth).astype(np.int16) % n] = True
    hit = np.flatnonzero(seen)
    gaps = np.append(np.diff(hit), n - (hit[-1] - hit[0]))
    return float(2 * np.pi - (gaps.max() - 1) * AZIMUTH_BIN)
