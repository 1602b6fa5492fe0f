"""Steps that are kept: done once, found again with the same bits, whatever happened in between."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from optshape_graph import EstimationError, InputError
from optshape_graph._arrays import Floats, Value
from optshape_graph.runs.interruption import Stopped
from optshape_graph.runs.kept import Kept, keeping


@dataclass(frozen=True, eq=False, repr=False)
class Found(Value):
    pose: Floats
    doubt: float


def found(k: int) -> Found:
    return Found(np.random.default_rng(k).normal(size=(4, 4)).T, np.nan if k % 2 else 1 / 3)


@contextmanager
def stopped(output: Path | None, said: str = "") -> Iterator[Kept]:
    """A run that is stopped when the block ends."""

    def run() -> Iterator[Kept]:
        with keeping(output) as kept:
            yield kept
            raise Stopped(2)

    steps = run()
    yield next(steps)
    with pytest.raises(Stopped) as ended:
        next(steps)
    assert said in ended.value.advice


def stopped_after(output: Path, count: int) -> list[Found]:
    """What a run had found when it was stopped."""
    with stopped(output) as kept:
        return [kept(Found, {"scan": k}, lambda k=k: found(k)) for k in range(count)]


def test_steps_are_done_once(tmp_path: Path) -> None:
    output = tmp_path / "a.json"
    before = stopped_after(output, 3)
    done = []

    def make(k: int) -> Found:
        done.append(k)
        return found(k)

    with keeping(output) as kept:
        after = [kept(Found, {"scan": k}, lambda k=k: make(k)) for k in (4, 2, 1, 0, 3)]
    assert done == [4, 3]  # another order, and one more: only what is new
    assert [after[3], after[2], after[1]] == before
    assert [one.pose.tobytes() for one in after] == [found(k).pose.tobytes() for k in (4, 2, 1, 0, 3)]
    assert not list(tmp_path.glob("*.journal"))  # the output is written in the block


def test_new_results_are_laid_out_as_restored_ones(tmp_path: Path) -> None:
    """Sums depend on it in the last bit."""
    [new] = stopped_after(tmp_path / "a.json", 1)
    with keeping(tmp_path / "a.json") as kept:
        old = kept(Found, {"scan": 0}, lambda: found(1))
    assert new.pose.strides == old.pose.strides


def test_what_differs_is_another_step(tmp_path: Path) -> None:
    output = tmp_path / "a.json"
    stopped_after(output, 1)
    with keeping(output) as kept:
        for of in ({"scan": 1}, {"scan": 0, "target": "b"}, {"scan": 0, "pose": np.eye(2)}):
            assert kept(float, of, lambda: 0.5) == 0.5
        assert kept(float, {"scan": 0, "pose": np.eye(2)}, lambda: 0.7) == 0.5


def test_failures_are_kept_and_bad_input_is_not(tmp_path: Path) -> None:
    output = tmp_path / "a.json"
    calls = []

    def fail(kind: type[Exception]) -> float:
        calls.append(kind)
        raise kind("no")

    for _ in range(2):
        with stopped(output, "1 scans and images were looked at, and kept in ") as kept:
            for kind in (EstimationError, InputError):
                with pytest.raises(kind, match="no"):
                    kept(float, {"scan": kind.__name__}, lambda kind=kind: fail(kind))
    assert calls == [EstimationError, InputError, InputError]


def test_threads_keep_side_by_side(tmp_path: Path) -> None:
    with stopped(tmp_path / "a.json") as kept, ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda k: kept(Found, {"scan": k}, lambda: found(k)), range(200)))
    with keeping(tmp_path / "a.json") as kept:
        assert all(kept(Found, {"scan": k}, lambda: found(-1)) == found(k) for k in range(200))


def test_without_output_nothing_is_written_and_nothing_started_leaves_nothing(tmp_path: Path) -> None:
    assert Kept()(int, {}, lambda: 3) == 3
    with stopped(None, "1 scans and images were looked at; nothing is kept without --json") as kept:
        assert kept(int, {}, lambda: 3) == 3
    stopped_after(tmp_path / "a.json", 0)
    assert list(tmp_path.iterdir()) == []


def test_damaged_lines_are_one_error(tmp_path: Path) -> None:
    journal = tmp_path / "a.json.journal"
    stopped_after(tmp_path / "a.json", 1)
    header, line = journal.read_text().splitlines()
    for made in (None, [], {"is": "Found"}, {"is": "Path"}, {"is": "Found", "pose": "x", "doubt": 1}):
        journal.write_text(f"{header}\n{json.dumps(json.loads(line) | {'made': made})}\n")
        with pytest.raises(InputError, match=r"a\.json\.journal: line 2"), keeping(tmp_path / "a.json") as kept:
            kept(Found, {"scan": 0}, lambda: found(0))


def test_the_journal_of_another_command_is_refused(tmp_path: Path) -> None:
    journal = tmp_path / "a.json.journal"
    journal.write_text("years of work\n")
    with pytest.raises(InputError, match="the journal of a run"), keeping(tmp_path / "a.json"):
        pass
    assert journal.read_text() == "years of work\n"
