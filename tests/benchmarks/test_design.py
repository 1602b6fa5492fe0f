"""Ratios of the design's speed, both sides measured in one run."""

import time

import numpy as np
import pytest

from optshape_graph.design.family import Family
from optshape_graph.design.judgement import SIX_ROTATIONS
from optshape_graph.design.multistart import search
from optshape_graph.design.polygons import centred, rotated
from optshape_graph.design.problem import Problem, random_parameters
from optshape_graph.design.released import sphere_grid
from optshape_graph.design.rings import UniformRings
from optshape_graph.design.sensitivity import MU, cell_scores
from optshape_graph.runs.workers import Pool

pytestmark = pytest.mark.benchmark

GRID = sphere_grid(25).tolist()


def plain_score(polygon, angles, areas=5, rings=4):
    """The score as it is written: loops over rotations, areas, motions, rings and edges."""
    worst = float("inf")
    for angle in angles:
        c, s = np.cos(angle), np.sin(angle)
        turned = [(c * x - s * y, s * x + c * y) for x, y in polygon]
        xs, ys = [p[0] for p in turned], [p[1] for p in turned]
        low, height, width = min(ys), max(ys) - min(ys), max(xs) - min(xs)
        for area in range(areas):
            points, chords = [], 0.0
            for ring in range(1, rings + 1):
                y, ends = low + height * (area + ring / (rings + 1)) / areas, []
                for (x0, y0), (x1, y1) in zip(turned, turned[1:] + turned[:1], strict=True):
                    if (y0 - y) * (y1 - y) < 0:
                        m = (x1 - x0) / (y1 - y0)
                        x = x0 + m * (y - y0)
                        points.append((-y - m * x, m))
                        ends.append(x)
                chords += abs(ends[0] - ends[1])
            least = min(sum((omega * a + u - m * v) ** 2 for a, m in points) for omega, u, v in GRID)
            worst = min(worst, width / height * least + MU * chords)
    return worst


def best_of(repeats, function):
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def test_a_batch_against_a_plain_loop_over_cells():
    family, rng = Family(4), np.random.default_rng(0)
    parameters = np.array([random_parameters(Problem(family), rng) for _ in range(64)])
    polygons = centred(family.polygons(parameters))
    rings = UniformRings()

    def batch():
        return cell_scores(rotated(polygons, SIX_ROTATIONS), rings).min(axis=(1, 2))

    plain = [plain_score(polygon.tolist(), SIX_ROTATIONS) for polygon in polygons[:4]]
    # The grid misses the worst motion, so its value is above the exact one; never below.
    assert (np.array(plain) >= batch()[:4] - 1e-9).all()
    slow = best_of(3, lambda: plain_score(polygons[0].tolist(), SIX_ROTATIONS))
    fast = best_of(10, batch) / len(polygons)
    print(f"\nper candidate: plain loop {1e3 * slow:.1f} ms, batch {1e6 * fast:.0f} us: {slow / fast:.0f} times")
    assert slow / fast >= 200


def test_two_workers_against_one():
    """The full search of 64 starts: minutes."""
    start = time.perf_counter()
    two = search(Problem(), 64, seed=0, pool=Pool(2))
    middle = time.perf_counter()
    one = search(Problem(), 64, seed=0, pool=Pool(1))
    end = time.perf_counter()
    ratio = (end - middle) / (middle - start)
    print(f"\n64 starts: two workers {middle - start:.0f} s, one {end - middle:.0f} s: {ratio:.2f} times")
    assert one.starts == two.starts
    assert ratio >= 1.7
