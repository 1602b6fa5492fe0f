"""What the sweep harness costs, and what a second worker gains."""

import time

import pytest

from optshape_graph.evaluation.simulation import (
    SimulationSweep,
    SweepTask,
    estimate_pose_by_method,
    run_simulation,
    run_task,
)
from optshape_graph.io import load_target

pytest.importorskip("joblib")
pytestmark = pytest.mark.benchmark

DRAWS = 60
"""Per cell, of four cells: 240 scans stand for the 2,400 of a full sweep."""


def sweep() -> SimulationSweep:
    return SimulationSweep(
        load_target("paper"), methods=("global",), distances=(6.0, 12.0, 20.0, 28.0), noise=("0",), draws=DRAWS,
        orientations=(("extreme", (0.35, 0.52, 0.52)),),
    )  # fmt: skip


def seconds(function) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def test_the_harness_costs_less_than_a_tenth_and_two_workers_gain_1_7(tmp_path):
    from threadpoolctl import threadpool_limits

    asked = sweep()
    tasks = [
        SweepTask(asked, "0", asked.orientations[0], distance, cell, range(DRAWS), estimate_pose_by_method)
        for cell, distance in enumerate(asked.distances)
    ]
    with threadpool_limits(1):
        run_task(SweepTask(asked, "0", asked.orientations[0], 6.0, 0, range(2), estimate_pose_by_method))
        bare = seconds(lambda: [run_task(task) for task in tasks])
    one = seconds(lambda: run_simulation(asked, tmp_path / "one"))
    run_simulation(SimulationSweep(asked.target, noise=("0",), distances=(6.0,), draws=8), tmp_path / "warm", workers=2)
    two = seconds(lambda: run_simulation(asked, tmp_path / "two", workers=2))
    print(f"harness beside the estimator: {100 * (one / bare - 1):.1f} %; two workers: {one / two:.2f} x one")
    assert one / bare < 1.10
    assert one / two >= 1.7
