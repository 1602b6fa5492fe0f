"""Returns of one surface, ring by ring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph._value import Value
from optshape_graph.detection.segments import LONGEST_GAP, Sweep


@dataclass(frozen=True, eq=False, repr=False)
class Runs(Value):
    """Returns in one plane, ring by ring, and the runs they form.

    Attributes:
        rows: (N,) of the sweep, by ring and azimuth.
        azimuth: (N,) rad, relative to the middle of them, across the seam.
        first: (K,) first return of each run, in `rows`.
        last: (K,) last return of each run.
        ring: (K,) of each run.
    """

    rows: Ints
    azimuth: Floats
    first: Ints
    last: Ints
    ring: Ints


def find_runs(sweep: Sweep, rows: Ints) -> Runs:
    """Cut returns, `rows` (N,) of one side of the sensor, into runs along their rings."""
    direction = np.exp(1j * sweep.azimuth[rows])
    azimuth = np.angle(direction * np.conj(direction.sum()))
    ring = sweep.ring[rows]
    turned, onward = np.diff(azimuth), np.diff(ring)
    if ((onward < 0) | ((onward == 0) & (turned < 0))).any():  # mostly they are in order already
        order = np.lexsort((azimuth, ring))
        rows, azimuth, ring = rows[order], azimuth[order], ring[order]
    starts = (np.diff(ring, prepend=-1) != 0) | (np.diff(azimuth, prepend=0.0) > LONGEST_GAP * sweep.resolution.step)
    first = np.flatnonzero(starts)
    last = np.append(first[1:], len(rows)) - 1 if len(rows) else first
    return Runs(rows, azimuth, first, last, ring[first])


def ring_ends(sweep: Sweep, rows: Ints) -> Ints:
    """(2 M,) of the `rows` (N,) at which rings begin, ring by ring, followed by those at which they end."""
    runs = find_runs(sweep, rows)
    first = np.flatnonzero(np.diff(sweep.ring[runs.rows], prepend=-1))
    last = np.append(first[1:], len(runs.rows)) - 1
    return np.asarray(runs.rows[np.concatenate([first, last])])
