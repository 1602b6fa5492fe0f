"""The harness: same results whatever runs the tasks, and nothing lost when it is killed."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

from optshape_graph import InputError, OptshapeError
from optshape_graph.evaluation.harness import run_tasks
from optshape_graph.runs.journal import locked
from optshape_graph.runs.workers import Pool

TASKS = list(range(40))
DESCRIBE = {"what": "random numbers", "version": 1}


def draw(task):
    """Some floating-point work on the task's own random numbers, linear algebra included."""
    rng = np.random.default_rng(np.random.SeedSequence(5, spawn_key=(task,)))
    matrix = rng.normal(size=(30, 30))
    return [{"task": task, "number": float(np.linalg.svd(matrix @ matrix.T)[1].sum()), "none": None}]


def test_results_are_in_order_and_the_same_with_one_and_two_workers(tmp_path):
    seen = []
    one = run_tasks(draw, TASKS, tmp_path / "one", DESCRIBE, progress=lambda done, total: seen.append((done, total)))
    two = run_tasks(draw, TASKS, tmp_path / "two", DESCRIBE, pool=Pool(2))
    assert one == two  # bit for bit: floats are equal
    assert [row["task"] for row in one] == TASKS
    assert seen == [(k, 40) for k in range(41)]


def test_dask_scheduler_with_two_worker_processes_gives_the_same(tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        rows = run_tasks(draw, TASKS, tmp_path / "dask", DESCRIBE, pool=Pool(dask=cluster.scheduler_address))
    assert rows == run_tasks(draw, TASKS, tmp_path / "local", DESCRIBE)


def test_no_scheduler_is_one_line(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("optshape_graph.runs.cluster.SCHEDULER_TIMEOUT_S", 1)
    with pytest.raises(OptshapeError, match=r"127\.0\.0\.1:1"):
        run_tasks(draw, TASKS, tmp_path, DESCRIBE, pool=Pool(dask="tcp://127.0.0.1:1"))


def test_a_killed_sweep_goes_on_and_recomputes_nothing(tmp_path):
    """SIGKILL in the middle; each task leaves a mark when it is computed."""
    script = tmp_path / "slow.py"
    script.write_text(
        textwrap.dedent("""
        import sys, time, pathlib
        from tests.evaluation.test_harness import DESCRIBE, TASKS, draw
        from optshape_graph.evaluation.harness import run_tasks

        def slow(task):
            with open(pathlib.Path(sys.argv[1]) / "computed.txt", "a") as log:
                log.write(f"{task}\\n")
            time.sleep(0.02)
            return draw(task)

        if __name__ == "__main__":
            run_tasks(slow, TASKS, pathlib.Path(sys.argv[1]) / "sweep", DESCRIBE)
    """)
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(["", os.getcwd(), str(tmp_path)])}
    process = subprocess.Popen([sys.executable, script, tmp_path], env=environment)
    deadline = time.monotonic() + 60
    while len(list((tmp_path / "sweep").glob("task-*.json"))) < 8 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    finished = {int(path.stem[5:]): path.read_bytes() for path in (tmp_path / "sweep").glob("task-*.json")}
    assert 8 <= len(finished) < len(TASKS)
    log = tmp_path / "computed.txt"
    log.write_text("")
    subprocess.run([sys.executable, script, tmp_path], env=environment, check=True)
    again = {int(line) for line in log.read_text().split()}
    assert again == set(TASKS) - finished.keys()
    resumed = run_tasks(draw, TASKS, tmp_path / "sweep", DESCRIBE)
    assert resumed == run_tasks(draw, TASKS, tmp_path / "whole", DESCRIBE)
    for number, content in finished.items():
        assert (tmp_path / "sweep" / f"task-{number:06d}.json").read_bytes() == content


def test_another_sweep_is_not_mixed_in(tmp_path):
    run_tasks(draw, TASKS[:3], tmp_path, DESCRIBE)
    with pytest.raises(InputError, match="holds another sweep"):
        run_tasks(draw, TASKS[:3], tmp_path, {**DESCRIBE, "version": 2})
    with pytest.raises(InputError, match="holds another sweep"):
        run_tasks(draw, TASKS, tmp_path, DESCRIBE)


def test_a_damaged_result_is_named(tmp_path):
    run_tasks(draw, TASKS[:3], tmp_path, DESCRIBE)
    (tmp_path / "task-000001.json").write_text('{"task": 2, "rows": []}')
    with pytest.raises(InputError, match=r"task-000001\.json"):
        run_tasks(draw, TASKS[:3], tmp_path, DESCRIBE)


def test_a_sweep_is_run_once_at_a_time(tmp_path):
    run_tasks(draw, TASKS[:3], tmp_path, DESCRIBE)
    with locked(tmp_path), pytest.raises(InputError, match="in use: another run writes to it"):
        run_tasks(draw, TASKS[:3], tmp_path, DESCRIBE)
