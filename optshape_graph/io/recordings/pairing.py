"""Which measurements of two sensors belong together."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats, Ints

ROUNDING = 1e-6
"""Stamps of an epoch in seconds are rounded to a quarter of this, as 64-bit floats."""


def nearest(stamps: Floats, others: Floats) -> Ints:
    """(N,) index of the stamp among `others` (M,), increasing and not empty, that is nearest to each of `stamps`."""
    after = np.searchsorted(others, stamps).clip(1, max(len(others) - 1, 1))
    if len(others) == 1:
        return np.zeros(len(stamps), dtype=np.int64)
    return np.where(stamps - others[after - 1] <= others[after] - stamps, after - 1, after)


def pair(stamps: Floats, others: Floats, tolerance: float) -> Ints:
    """Pair each stamp with the nearest of the others, if it is that one's nearest too and not too far.

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
    """(N,) whether to keep each stamp so that kept ones are at least `interval` apart, the first being kept."""
    keep = np.zeros(len(stamps), dtype=bool)
    last = -np.inf
    for k, stamp in enumerate(stamps):
        keep[k] = stamp - last >= interval - ROUNDING
        last = stamp if keep[k] else last
    return keep
