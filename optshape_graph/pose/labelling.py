"""Association by enumeration: every consistent way of assigning edge points to edges, all solved at once.

Rings cut a convex polygon in chords. From the top ring down, the left ends of the chords walk along
consecutive edges one way round, the right ends the other way, and no edge is met from both sides. So a labelling is
an edge at the top left, and how many edges each end passes between one ring and the next: n - 2 passes at most,
those skipped at the top included.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations_with_replacement
from math import comb

import numpy as np

from optshape_graph._arrays import Floats, Ints

MAX_LABELLINGS = 800
"""Beyond this many, the enumeration works on fewer rings, evenly picked."""


def count_labellings(n_edges: int, n_rings: int) -> int:
    """Number of consistent labellings of `n_rings` rings over a polygon with `n_edges` edges."""
    # n - 2 passes or fewer, each at one of 2 (M - 1) gaps between rings or at the top: multisets.
    places = 2 * (n_rings - 1) + 1
    return n_edges * comb(places + n_edges - 2, n_edges - 2)


@lru_cache(maxsize=16)
def enumerate_labellings(n_edges: int, n_rings: int) -> tuple[Ints, Floats]:
    """List every consistent labelling.

    Args:
        n_edges: edges of the polygon, counted counter-clockwise seen from +x (so that the left ends, seen from
            the sensor, walk towards smaller indices from the top down).
        n_rings: rings, counted from the lowest up.

    Returns:
        Labels (K, 2 M), left end before right end, rings from the lowest up; and the same as indicators
        (K, 2 M n), so that summing any quantity over a labelling's points is a matrix product.
    """
    left, right = {}, {}
    for passes in range(n_edges - 1):
        positions = list(combinations_with_replacement(range(1, n_rings), passes))
        passed = np.zeros((len(positions), n_rings), dtype=np.int64)
        for row, where in zip(passed, positions, strict=True):
            for place in where:
                row[place:] += 1
        left[passes] = -passed[:, ::-1]  # from the lowest ring up
        right[passes] = passed[:, ::-1]
    blocks = []
    for skipped in range(n_edges - 1):
        for on_left in range(n_edges - 1 - skipped):
            for on_right in range(n_edges - 1 - skipped - on_left):
                a, b = left[on_left], right[on_right] + 1 + skipped
                if not (len(a) and len(b)):
                    continue
                block = np.empty((len(a), len(b), n_rings, 2), dtype=np.int64)
                block[..., 0], block[..., 1] = a[:, None], b[None]
                blocks.append(block.reshape(-1, 2 * n_rings))
    shapes = np.concatenate(blocks)
    labels = (shapes[None] + np.arange(n_edges)[:, None, None]).reshape(-1, 2 * n_rings) % n_edges
    indicators = np.eye(n_edges)[labels].reshape(len(labels), -1)
    labels.setflags(write=False)
    indicators.setflags(write=False)
    return labels, indicators
