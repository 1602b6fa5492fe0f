"""Workers: the same results whatever runs the tasks, a killed one costs a try, none is left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from optshape_graph import InputError, OptshapeError
from optshape_graph.runs.workers import Lost, Pool, in_order
from tests.faults.harness import gone


def square(task: int) -> int:
    return task * task


def killed(folder: Path, task: int, times: int = 1) -> int:
    """A task whose worker is killed at its first tries, where its number is 3."""
    mark = folder / f"{task}-{len(list(folder.glob(f'{task}-*')))}"
    mark.touch()
    if task == 3 and len(list(folder.glob("3-*"))) <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return task


def failing(task: int) -> int:
    if task == 2:
        raise InputError("not this one")
    return task


def numbered(count: int) -> list[tuple[int, int]]:
    return list(enumerate(range(count)))


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_all_are_done_once(workers: int) -> None:
    found = dict(Pool(workers).run(square, numbered(23)))
    assert found == {k: k * k for k in range(23)}
    assert list(in_order(Pool(workers).run(square, numbered(23)))) == [k * k for k in range(23)]


def test_a_killed_worker_costs_one_try(tmp_path: Path) -> None:
    assert dict(Pool(2).run(partial(killed, tmp_path), numbered(8))) == {k: k for k in range(8)}
    assert {path.name for path in tmp_path.glob("3-*")} == {"3-0", "3-1"}


def test_a_task_that_kills_its_worker_twice_is_reported(tmp_path: Path) -> None:
    found = dict(Pool(2).run(partial(killed, tmp_path, times=9), numbered(8)))
    assert found.pop(3) == Lost("its worker was killed twice (signal 9)")
    assert found == {k: k for k in range(8) if k != 3}


def test_what_a_task_raises_is_raised(tmp_path: Path) -> None:
    for workers in (1, 2):
        with pytest.raises(InputError, match="not this one"):
            dict(Pool(workers).run(failing, numbered(5)))


def test_tasks_are_taken_as_they_are_needed() -> None:
    taken = []

    def tasks():
        for k in range(100):
            taken.append(k)
            yield k, k

    results = Pool(2).run(square, tasks())
    for _ in range(10):
        next(results)
    assert len(taken) <= 10 + 2
    results.close()


def hanging(task: int) -> int:
    time.sleep(600)
    return task


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_no_worker_outlives_its_parent(number: signal.Signals, tmp_path: Path) -> None:
    script = tmp_path / "main.py"
    script.write_text(
        "from optshape_graph.runs.workers import Pool\nfrom optshape_graph.runs.interruption import stop_on_signals\n"
        "from tests.runs.test_workers import hanging, numbered\n"
        "if __name__ == '__main__':\n    stop_on_signals()\n    list(Pool(2).run(hanging, numbered(4)))\n"
    )
    root = Path(__file__).parents[2]
    parent = subprocess.Popen([sys.executable, script], env=os.environ | {"PYTHONPATH": str(root)}, stderr=-3)
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
    deadline = time.monotonic() + 60
    while len(started := workers_among(children)) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)
    parent.send_signal(number)
    parent.wait(timeout=30)
    assert gone([int(pid) for pid in started], seconds=30.0) == []


def workers_among(children: Path) -> list[str]:
    """Process ids of the spawned workers below a process."""
    try:
        pids = children.read_text().split()
    except OSError:
        return []
    return [pid for pid in pids if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def test_workers_that_cannot_start_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("optshape_graph.runs.processes._serve", os.abort)
    monkeypatch.setattr("optshape_graph.runs.processes.MOST_DEATHS", 2)
    with pytest.raises(OptshapeError, match="workers end before they begin"):
        dict(Pool(2).run(square, numbered(50)))


def test_at_least_one_worker() -> None:
    with pytest.raises(InputError, match="at least one worker, found 0"):
        Pool(0)
