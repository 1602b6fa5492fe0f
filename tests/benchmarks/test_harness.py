"""What the sweep harness costs, and what a second worker gains."""

import time

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from optshape_graph.evaluation.harness import run_tasks
from optshape_graph.evaluation.simulation import (
    SCANS_PER_TASK,
    SimulationSweep,
    SweepTask,
    run_simulation,
    run_task,
)
from optshape_graph.io import load_target
from optshape_graph.runs.workers import Pool

pytestmark = pytest.mark.benchmark

DRAWS = 144
"""Per cell, of four cells: 576 scans stand for the 2,400 of a full sweep, on which what is paid once weighs less."""


def sweep(draws: int = DRAWS) -> SimulationSweep:
    return SimulationSweep(
        load_target("paper"), methods=("global",), distances=(6.0, 12.0, 20.0, 28.0), noise=("0",), draws=draws,
        orientations=(("extreme", (0.35, 0.52, 0.52)),),
    )  # fmt: skip


def recorded(rows):
    """A task that is done already."""
    return rows


def test_the_harness_costs_less_than_a_tenth_of_the_estimator(tmp_path):
    """Its own processor time on the very rows: files, digests, reading back."""
    asked = sweep()
    tasks = [
        SweepTask(asked, "0", asked.orientations[0], distance, cell, range(first, first + SCANS_PER_TASK),
                  None)
        for cell, distance in enumerate(asked.distances) for first in range(0, DRAWS, SCANS_PER_TASK)
    ]  # fmt: skip
    run_task(tasks[0])
    start = time.process_time()
    with threadpool_limits(1):
        rows = [run_task(task) for task in tasks]
    work = time.process_time() - start
    start = time.process_time()
    assert run_tasks(recorded, rows, tmp_path, asked.describe()) == [row for block in rows for row in block]
    harness = time.process_time() - start
    print(f"\n{len(tasks) * SCANS_PER_TASK} scans: {work:.1f} s; harness {harness:.2f} s: {100 * harness / work:.1f} %")
    assert harness / work < 0.10


def test_two_workers_gain_1_7(tmp_path):
    """In wall-clock time, best of three: needs two idle cores."""

    def seconds(workers: int, attempt: int) -> float:
        start = time.perf_counter()
        run_simulation(sweep(), tmp_path / f"{workers}-{attempt}", pool=Pool(workers))
        return time.perf_counter() - start

    run_simulation(sweep(SCANS_PER_TASK), tmp_path / "warm", pool=Pool(2))
    one, two = np.min([[seconds(workers, attempt) for workers in (1, 2)] for attempt in range(3)], axis=0)
    print(f"\none worker {one:.1f} s, two {two:.1f} s: {one / two:.2f} times")
    assert one / two >= 1.7
