"""How the rings on a surface end: where the range jumps back, where something stands before it, where it bends away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Ints
from optshape_graph._value import Value
from optshape_graph.detection.patches import FEWEST_RETURNS
from optshape_graph.detection.runs import ring_ends
from optshape_graph.detection.segments import LONGEST_GAP, Sweep


@dataclass(frozen=True, eq=False, repr=False)
class Borders(Value):
    """Both ends of each ring on a surface.

    Attributes:
        open: (2 M,) the range jumps back beyond the end, or nothing returns: the surface ends there.
        hidden: (2 M,) what follows stands before it: the surface may go on. Where neither holds it bends away.
    """

    open: Bools
    hidden: Bools


def borders(sweep: Sweep, rows: Ints) -> Borders:
    """Look beyond the ends of a surface's rings.

    Up to a few returns beyond an end, and segments as short, are passed over: part of their light came from what is
    behind.

    Args:
        sweep: the scan.
        rows: (N,) of the sweep, the returns of the surface.
    """
    segment = sweep.segment
    long = np.flatnonzero(sweep.last - sweep.first + 1 >= FEWEST_RETURNS)
    ends = ring_ends(sweep, rows)
    side = np.repeat([-1, 1], len(ends) // 2)
    further = (ends + FEWEST_RETURNS * side).clip(0, len(sweep) - 1)
    goes_on = (segment[further] == segment[ends]) & (further != ends)
    after, before = np.searchsorted(long, segment[ends], "right"), np.searchsorted(long, segment[ends]) - 1
    place = np.where(side > 0, after, before)
    there = (place >= 0) & (place < len(long))
    neighbour = long[place.clip(0, len(long) - 1)]
    beyond = np.where(side > 0, sweep.first[neighbour], sweep.last[neighbour])
    there &= sweep.ring[beyond] == sweep.ring[ends]
    there &= np.abs(sweep.azimuth[beyond] - sweep.azimuth[ends]) <= 2 * LONGEST_GAP * sweep.resolution.step
    hidden = there & ~goes_on & (sweep.range[beyond] < sweep.range[ends])
    return Borders(open=~goes_on & ~hidden, hidden=hidden)
