"""Odd ring ends: the last return is a stray beyond the edge, or the last few returns are lost."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.simulation.rays import at
from optshape_graph.simulation.surfaces import Patch

MOST_LOST = 3
"""Returns that an odd end lacks at most."""


NEXT_TO = np.cos(np.radians(3.0))
"""Rays of a ring count as neighbours if the cosine of their angle exceeds this."""


def make_odd_ends(
    k: int,
    target: Patch,
    origins: Floats,
    directions: Floats,
    n_rings: int,
    ranges: Floats,
    surface: Ints,
    share: float,
    rng: np.random.Generator,
) -> None:
    """Make a share of a target's ring ends odd, in place: each is a stray or loses one to three, equally likely.

    A stray is one firing further than the ring's last return, at the range of the target's plane. Firings whose returns
    are lost return nothing. A ring keeps at least one return.

    Args:
        k: number of the target among the surfaces.
        target: the target.
        origins: (N, 3) of the rays, ring by ring in every column, metres, world frame; or (1, 3) of all.
        directions: (N, 3) unit vectors, world frame.
        n_rings: rings in a column.
        ranges: (N,) metres; changed.
        surface: (N,) which surface each ray meets, -1: none; changed.
        share: probability that an end is odd.
        rng: source of randomness.
    """
    rays = np.flatnonzero(surface == k)
    columns = len(surface) // n_rings
    for ring in np.unique(rays % n_rings):
        column = rays[rays % n_rings == ring] // n_rings
        # A target behind the sensor is cut by the ends of the revolution; it begins after its widest gap.
        gaps = np.diff(column, append=column[0] + columns)
        column = np.roll(column, -1 - int(gaps.argmax()))
        for outward in (1, -1):
            column = column[::-1]
            if rng.uniform() >= share:
                continue
            lost = int(rng.integers(MOST_LOST + 1))
            if lost:
                lost = min(lost, len(column) - 1)
                gone, column = column[:lost] * n_rings + ring, column[lost:]
                ranges[gone], surface[gone] = np.inf, -1
            else:
                last, stray = (int(c % columns * n_rings + ring) for c in (column[0], column[0] + outward))
                T = target.T_world_patch
                normal, o, d = T[:3, 0], at(origins, np.array([stray]))[0], directions[stray]
                there = float((T[:3, 3] - o) @ normal / (d @ normal))
                if d @ directions[last] > NEXT_TO and 0 < there < ranges[stray]:  # else not fired, or hidden
                    ranges[stray], surface[stray] = there, k
