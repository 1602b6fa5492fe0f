"""Labellings are exactly those that a convex polygon can produce."""

import numpy as np
import pytest

from optshape_graph import Target
from optshape_graph.pose.association import count_labellings, enumerate_labellings


@pytest.mark.parametrize("n_edges", [3, 4, 5, 6])
@pytest.mark.parametrize("n_rings", [2, 3, 5, 8])
def test_count_matches_enumeration(n_edges: int, n_rings: int) -> None:
    labels, indicators = enumerate_labellings(n_edges, n_rings)
    assert len(labels) == count_labellings(n_edges, n_rings) == len(np.unique(labels, axis=0))
    assert indicators.shape == (len(labels), 2 * n_rings * n_edges)
    assert (indicators.sum(axis=1) == 2 * n_rings).all()


@pytest.mark.parametrize("seed", range(30))
def test_chords_of_random_polygons_are_among_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 7))
    angles = np.sort(rng.uniform(0, 2 * np.pi, n))
    if np.diff(np.append(angles, angles[0] + 2 * np.pi)).max() > 0.9 * np.pi:
        angles = np.arange(n) * 2 * np.pi / n + rng.uniform(0, 0.4)
    target = Target.from_polygon(np.column_stack([np.cos(angles), np.sin(angles)]))
    low, high = target.polygon[:, 1].min(), target.polygon[:, 1].max()
    levels = np.sort(rng.uniform(low + 1e-3, high - 1e-3, 6))
    start, step = target.polygon, np.roll(target.polygon, -1, axis=0) - target.polygon
    labels = []
    for z in levels:
        s = (z - start[:, 1]) / np.where(step[:, 1] == 0, np.inf, step[:, 1])
        crossed = np.flatnonzero((s >= 0) & (s < 1))
        y = start[crossed, 0] + s[crossed] * step[crossed, 0]
        # The face that the sensor sees has y to the left: the left end of a chord is the one with the larger y.
        labels += [crossed[y.argmax()], crossed[y.argmin()]]
    known, _ = enumerate_labellings(n, len(levels))
    assert (known == np.array(labels)).all(axis=1).any()
