"""One template measurement against one callback for each point: the same cost and the same linear system."""

import time
from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import H

from optshape_graph.factors import TemplateFactor, TemplateMeasurement, edge_rows
from optshape_graph.factors._rows import triangular
from optshape_graph.factors.plane_returns import plane_measurement
from optshape_graph.se3 import skew
from tests.factors.support import TARGET, edge_points, random_pose, retract
from tests.factors.test_plane_returns import dense_rows, near, with_all_errors

N_POINTS = 2000
SIGMA = 0.01


def best_of(function: Callable[[], object], repeat: int) -> float:
    """Return the shortest time of a call, seconds."""
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def point_callback(p: np.ndarray, normal: np.ndarray, offset: float) -> gtsam.CustomFactor:
    """Return what one writes first: a callback for a point, whose Jacobian is -n R [p]x, n R."""
    n = np.append(0.0, normal) / SIGMA
    p_cross = skew(p)

    def evaluate(this, values, jacobians):
        pose = values.atPose3(this.keys()[0])
        if jacobians is not None:
            n_R = n @ pose.rotation().matrix()
            jacobians[0] = np.concatenate([-n_R @ p_cross, n_R])[None]
        return np.array([n @ pose.transformFrom(p) - offset / SIGMA])

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [H(0)], evaluate)


@pytest.mark.benchmark
def test_measurement_against_a_callback_for_each_point(capsys):
    rng = np.random.default_rng(0)
    T = random_pose(rng)
    points, edge = edge_points(rng, np.linalg.inv(T), N_POINTS, noise=SIGMA)
    normals, offsets = TARGET.normals[edge], TARGET.offsets[edge]
    values = gtsam.Values()
    values.insert(H(0), gtsam.Pose3(retract(T, 0.05 * rng.normal(size=6))))

    def of_template() -> gtsam.NonlinearFactorGraph:
        A, r = edge_rows(points, normals, offsets)
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(TemplateFactor(TemplateMeasurement.from_rows(A / SIGMA, r / SIGMA, T), H(0)))
        return graph

    def of_points() -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for p, n, c in zip(points, normals, offsets, strict=True):
            graph.push_back(point_callback(p, n, c))
        return graph

    template, single = of_template(), of_points()
    A, b = (np.stack(x) for x in zip(*(g.linearize(values).hessian() for g in (template, single)), strict=True))
    np.testing.assert_allclose(A[0], A[1], atol=1e-8 * np.abs(A).max())
    np.testing.assert_allclose(b[0], b[1], atol=1e-8 * np.abs(b).max())

    first = best_of(lambda: of_points().linearize(values), 5) / best_of(lambda: of_template().linearize(values), 50)
    following = best_of(lambda: single.linearize(values), 5) / best_of(lambda: template.linearize(values), 500)
    with capsys.disabled():
        print(f"\nmeasurement of {N_POINTS} points against callbacks: {first:.0f} x first, {following:.0f} x next")
    assert first >= 50
    assert following >= 1000


@pytest.mark.benchmark
def test_plane_rows_of_a_near_scan_of_128_rings(capsys):
    """Against one dense system of a column for each ring's errors; and how the time grows with the returns."""

    def against_dense(count: int) -> tuple[int, float, float]:
        scan = near("os1-128", 1.2)
        kept = np.sort(np.random.default_rng(0).permutation(len(scan))[:count])
        scan = scan.select(kept)
        returns = with_all_errors(scan)
        best = best_of(lambda: plane_measurement(returns), 7)
        return len(scan), best, best_of(lambda: triangular(dense_rows(returns)), 3)

    (few, small, _), (many, best, dense) = against_dense(3000), against_dense(10**6)
    exponent = np.log(best / small) / np.log(many / few)
    with capsys.disabled():
        print(f"\nplane rows, {many} returns of 128 rings: {dense / best:.0f} x a dense system; "
              f"from {few} returns on, time grows with exponent {exponent:.2f}")  # fmt: skip
    assert dense / best >= 15
    assert exponent <= 1.2
