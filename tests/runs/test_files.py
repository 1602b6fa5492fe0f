"""Runs over many files: the document of all, byte for byte the same however often they were stopped, in flat memory."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from optshape_graph import InputError
from optshape_graph.runs.files import UNREADABLE, Outcome, run_files
from optshape_graph.runs.journal import journal_of
from optshape_graph.runs.workers import Pool

ROOT = Path(__file__).resolve().parents[2]

MANY = 2_000 if os.environ.get("FAULTS", "1") == "1" else 100_000


def look(paths: Sequence[str]) -> list[Outcome]:
    """Results as large as those of scans, which show what was looked at together."""
    found = []
    for path in paths:
        status = UNREADABLE if path.endswith("bad") else "ok"
        entry = {"scan": path, "numbers": [len(path) / 7] * 200, "together": list(paths)}
        found.append(Outcome(status, () if status == "ok" else (f"{path}: bad",), entry))
    return found


def look_and_die(paths: Sequence[str]) -> list[Outcome]:
    """Whoever looks at one of the files is killed."""
    if "scan_5" in paths:
        os.kill(os.getpid(), signal.SIGKILL)
    return look(paths)


def failed(path: str, reason: str) -> Outcome:
    return Outcome("failed", (reason,), {"scan": path})


def document(paths: list[str], output: Path, **options: object) -> bytes:
    with run_files(look, paths, failed, form="estimate", describe={}, output=output, **options):
        assert journal_of(output).exists()
    assert not journal_of(output).exists()
    return output.read_bytes()


def test_the_document_does_not_depend_on_what_ran_it(tmp_path: Path) -> None:
    paths = [f"scan_{k}" for k in range(20)] + ["bad"]
    one = document(paths, tmp_path / "one.json")
    assert [scan["scan"] for scan in json.loads(one)["scans"]] == paths
    assert document(paths, tmp_path / "two.json", pool=Pool(2)) == one
    assert document([], tmp_path / "none.json") == b'{\n  "schema": "optshape/estimate/1",\n  "scans": []\n}\n'


def test_a_run_that_broke_off_goes_on(tmp_path: Path) -> None:
    paths = [f"scan_{k}" for k in range(10)]
    whole = document(paths, tmp_path / "whole.json")

    def broken(done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    output = tmp_path / "a.json"
    with pytest.raises(KeyboardInterrupt):
        document(paths, output, progress=broken)
    assert len(journal_of(output).read_bytes().splitlines()) == 5  # a head, and four files
    seen: list[int] = []
    assert document(paths, output, progress=lambda done, total: seen.append(done)) == whole
    assert seen == [4, 5, 6, 7, 8, 9, 10]


@pytest.mark.parametrize("stopped_at", [1, 7, 8, 30])
def test_files_that_are_looked_at_together_are_so_again(tmp_path: Path, stopped_at: int) -> None:
    paths = [f"scan_{k}" for k in range(70)]
    whole = document(paths, tmp_path / "whole.json", at_once=10)
    together = [scan["together"] for scan in json.loads(whole)["scans"]]
    assert together == [paths[k - k % 4 : k - k % 4 + 4] for k in range(70)]  # 16 chunks and more
    assert document(paths, tmp_path / "two.json", at_once=10, pool=Pool(2)) == whole

    def broken(done: int, total: int) -> None:
        if done == stopped_at:
            raise KeyboardInterrupt

    output = tmp_path / "a.json"
    with pytest.raises(KeyboardInterrupt):
        document(paths, output, at_once=10, progress=broken)
    assert document(paths, output, at_once=10) == whole


def test_a_file_that_kills_costs_none_of_those_beside_it(tmp_path: Path) -> None:
    paths = [f"scan_{k}" for k in range(40)]
    run = run_files(look_and_die, paths, failed, form="estimate", describe={}, pool=Pool(2), at_once=10)
    with run as journal:
        statuses = [line["status"] for line in journal]
    assert statuses == ["failed" if path == "scan_5" else "ok" for path in paths]


def test_files_that_have_changed_are_another_run(tmp_path: Path) -> None:
    scan = tmp_path / "scan"
    scan.write_text("a")

    def broken(done: int, total: int) -> None:
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        document([str(scan)], tmp_path / "a.json", progress=broken)
    scan.write_text("ab")
    with pytest.raises(InputError, match="holds what is finished of another run"):
        document([str(scan)], tmp_path / "a.json")


def test_where_no_file_can_be_read_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="1bad: bad"):
        document(["1bad", "2bad"], tmp_path / "a.json")
    assert list(tmp_path.iterdir()) == []


SCRIPT = """
import resource, sys, time
from pathlib import Path
from tests.runs.test_files import document
paths = [f"scan_{k:06d}" for k in range(int(sys.argv[1]))]
begun = time.perf_counter()
def stop(done, total):
    if sys.argv[3] == "stop" and done == total: raise SystemExit
    if sys.argv[3] == "go on": print(time.perf_counter() - begun); raise SystemExit
try:
    document(paths, Path(sys.argv[2]), progress=stop)
finally:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def measured(count: int, output: Path, how: str) -> list[float]:
    command = [sys.executable, "-c", SCRIPT, str(count), str(output), how]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, cwd=ROOT)
    return [float(line) for line in done.stdout.split()]


def test_memory_is_flat_and_going_on_is_quick(tmp_path: Path) -> None:
    [few] = measured(100, tmp_path / "few.json", "whole")
    [many] = measured(MANY, tmp_path / "many.json", "stop")
    assert many - few < 60_000  # kB: names of files, and 8 bytes for each line
    begun = time.perf_counter()
    seconds, again = measured(MANY, tmp_path / "many.json", "go on")
    assert seconds < 5.0
    assert again - few < 60_000
    assert time.perf_counter() - begun < 60.0
