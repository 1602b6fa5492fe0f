"""`optshape --profile`: where a run's time went."""

import cProfile
import pstats
import time

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph import load_target
from optshape_graph.cli.main import cli
from optshape_graph.cli.profiling import time_by_room


@pytest.fixture
def scan(tmp_path):
    path = tmp_path / "scan.pcd"
    made = CliRunner().invoke(cli, ["simulate", "--range", "8", "--noise", "1", "-o", str(path)])
    assert made.exit_code == 0, made.output
    return path


def test_tables_go_to_standard_error_and_the_result_stays(scan):
    plain = CliRunner().invoke(cli, ["estimate", str(scan), "--target", "paper"])
    run = CliRunner().invoke(cli, ["--profile", "estimate", str(scan), "--target", "paper"])
    assert run.exit_code == 0, run.output
    assert run.stdout == plain.stdout
    rooms = {line.split()[0] for line in run.stderr.splitlines() if line.strip().endswith("%")}
    assert {"pose", "io"} <= rooms
    assert "own s" in run.stderr


def test_a_failed_run_is_profiled_too(tmp_path):
    run = CliRunner().invoke(cli, ["--profile", "estimate", str(tmp_path / "none.pcd"), "--target", "paper"])
    assert run.exception
    assert "own s" in run.stderr


def test_rooms_add_up_and_libraries_are_charged_to_their_callers():
    profiler, start = cProfile.Profile(), time.perf_counter()
    profiler.enable()
    load_target("paper")
    rng = np.random.default_rng(0)
    while time.perf_counter() - start < 0.2:
        np.linalg.svd(rng.normal(size=(60, 60)))
    profiler.disable()
    stats = pstats.Stats(profiler)
    rooms = time_by_room(stats.stats)
    assert sum(rooms.values()) == pytest.approx(stats.total_tt, rel=1e-6)
    assert rooms["other"] > rooms.get("io", 0.0), "what no room of the package asked for"
