"""Signals and kills at any moment: nothing finished is lost, nothing is left behind, and going on ends the same."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.calibration.session_support import write_session
from tests.faults.harness import MANY, command, descendants, environment, gone, linux_only, started
from tests.faults.inputs import make_inputs

for library in ("matplotlib", "pyarrow"):
    pytest.importorskip(library)

pytestmark = linux_only

SCANS, POSES, SEEDS, STARTS = (40, 12, 8, 2) if MANY == 1 else (2000, 60, 24, 4)

MAP = "map drive --targets square@1 --sensor vlp16 --odometry drive/odometry.tum --keyframe 0.05 1 --json a.json"

RUNS = {
    "estimate": ("estimate @many.txt --target target.yaml --sensor sensor.yaml --json a.json", "a.json"),
    "estimate on workers": (
        "estimate @many.txt --target target.yaml --sensor sensor.yaml --json a.json --workers 2", "a.json",
    ),
    "detect": ("detect @rooms.txt --target square@1 --sensor vlp16 --json a.json", "a.json"),
    "map": (MAP, "a.json"),
    "map on workers": (f"{MAP} --workers 2", "a.json"),
    "evaluate": (
        f"evaluate simulation --distance 4 --distance 8 --rpy 0 0 0 --noise 1 --seeds {SEEDS} --method global -o sweep",
        "sweep/scans.csv",
    ),
    "calibrate mocap": ("calibrate mocap session.yaml --json a.json", "a.json"),
    "calibrate rig": ("calibrate rig session.yaml --json a.json", "a.json"),
    "calibrate camera": ("calibrate camera views/session.yaml --use-target-points --json a.json", "a.json"),
    "optimise": (f"design optimise --starts {STARTS} --sides 3 --rings 2 2 --area 0.5 -o shape.yaml", "shape.yaml"),
}  # fmt: skip
"""A run of each command that goes on where it was stopped, and what it writes."""


def allowed(seconds: float) -> float:
    """Seconds that an end may take: as asked by `make faults`; beside other tests, which are load, ten more."""
    return seconds if MANY > 1 else seconds + 10.0


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Inputs: many crops, some full scans, and a drive with odometry."""
    from optshape_graph.io import load_sensor, load_target, write_scan
    from optshape_graph.io.trajectories import Trajectory, write_tum
    from optshape_graph.simulation import NoiseModel, pose_from_rpy, room, simulate

    folder = tmp_path_factory.mktemp("signals") / "world"
    make_inputs(folder)
    names = [path.name for path in sorted(folder.glob("*m*.pcd")) if path.name != "room.pcd"]
    (folder / "many.txt").write_text("".join(f"{names[k % len(names)]}\n" for k in range(SCANS)))
    (folder / "rooms.txt").write_text("room.pcd\n" * 6)
    (folder / "drive").mkdir()
    sensor = load_sensor("vlp16")
    scene = room([(load_target("square@1"), pose_from_rpy([6.0, 0.5, 0.0], [0.0, 0.1, 0.2]))])
    poses = [pose_from_rpy([3.6 * k / POSES, 0.0, 0.0], [0.0, 0.0, 0.24 * k / POSES]) for k in range(POSES)]
    for k, pose in enumerate(poses):
        scan = simulate(scene, sensor, pose, noise=NoiseModel.of(sensor), rng=k).scan
        write_scan(folder / "drive" / f"{k:03d}.pcd", scan)
    (folder / "drive" / "timestamps.txt").write_text("".join(f"{k:.1f}\n" for k in range(POSES)))
    write_tum(folder / "drive" / "odometry.tum", Trajectory(np.array(poses), np.arange(float(POSES))))
    (folder / "views").mkdir()
    write_session(folder / "views")
    return folder


def outputs(folder: Path) -> list[Path]:
    """What the runs write."""
    return [folder / name for name in ("a.json", "a.json.journal", "sweep", "shape.yaml", "shape.starts")]


def clean(folder: Path) -> None:
    """Remove what a run wrote."""
    for path in outputs(folder):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


@cache
def unbroken(name: str, world: Path) -> tuple[bytes, float]:
    """What a run writes when nothing stops it, and the seconds that it takes."""
    line, written = RUNS[name]
    clean(world)
    begun = time.monotonic()
    done = subprocess.run(command(*line.split()), cwd=world, env=environment(), capture_output=True, text=True)
    assert done.returncode in (0, 3), done.stderr
    assert not (world / "a.json.journal").exists()
    return (world / written).read_bytes(), time.monotonic() - begun


SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)

PAIRS = [
    (name, number)
    for k, name in enumerate(RUNS)
    for n, number in enumerate(SIGNALS)
    if MANY > 1 or (k % 3 == n and name != "map on workers")
]
"""By `make test` each run but one is stopped by one of the signals."""


@pytest.mark.parametrize(("name", "number"), PAIRS)
def test_stopped_and_gone_on(name: str, number: signal.Signals, world: Path) -> None:
    line, written = RUNS[name]
    whole, seconds = unbroken(name, world)
    moments = random.Random(f"{name} {number}")
    for _ in range(MANY):
        clean(world)
        with started(line.split(), world) as process:
            time.sleep(moments.uniform(0.45, 0.95) * seconds)
            below = descendants(process.pid)
            process.send_signal(number)
            begun = time.monotonic()
            status = process.wait(timeout=60)
            assert time.monotonic() - begun < allowed(2.0)
            said = process.communicate()[1]
        if status not in (0, 3):  # it had not finished before
            assert status in (-number, 128 + number), said  # while Python itself starts or ends, the signal is Python's
            if status == 128 + number:
                assert said.splitlines()[-1].startswith(f"optshape: stopped by {number.name}"), said
                assert "goes on" in said or not any(path.exists() for path in outputs(world)), said
        assert "Traceback" not in said, said
        assert gone(below, allowed(5.0)) == []
        again = subprocess.run(command(*line.split()), cwd=world, env=environment(), capture_output=True, text=True)
        assert again.returncode in (0, 3), again.stderr
        assert_same(name, (world / written).read_bytes(), whole)
        assert not list(world.rglob("*.journal"))
    clean(world)


@pytest.mark.parametrize("name", ["estimate", "map", "evaluate", "optimise"] if MANY > 1 else ["estimate"])
def test_killed_again_and_again(name: str, world: Path) -> None:
    """By SIGKILL at random moments of one run after the other, which each goes on where the one before was."""
    line, written = RUNS[name]
    whole, seconds = unbroken(name, world)
    moments, kills, finished = random.Random(name), 0, 0
    clean(world)
    while kills < 3 * MANY or not finished:
        with started(line.split(), world) as process:
            if kills < 3 * MANY:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(moments.uniform(0.0, min(seconds, 5.0 + 2 * seconds / (3 * MANY))))
            else:
                process.wait()
            kills += process.poll() is None
            if process.poll() is None:
                process.kill()
            said = process.communicate()[1]
        assert process.returncode in (0, 3, -signal.SIGKILL), said
        if process.returncode >= 0:
            finished += 1
            assert_same(name, (world / written).read_bytes(), whole)
            assert not list(world.rglob("*.journal"))
            clean(world)
    print(f"{name}: {kills} kills, finished {finished} times, {seconds:.1f} s unbroken")


def assert_same(name: str, found: bytes, expected: bytes) -> None:
    """Assert that a run wrote what an unbroken one writes: byte for byte, maps to 1e-9."""
    if name.startswith("map"):
        assert_same_map(json.loads(found), json.loads(expected))
    else:
        assert found == expected


def assert_same_map(found: dict[str, object], expected: dict[str, object]) -> None:
    """Assert that two maps are equal to 1e-9."""
    assert found.keys() == expected.keys()
    for key in ("landmarks", "trajectory"):
        for a, b in zip(found[key], expected[key], strict=True):
            for field, value in b.items():
                if isinstance(value, list):
                    np.testing.assert_allclose(a[field], value, rtol=0, atol=1e-9)
                else:
                    assert a[field] == value


@pytest.mark.parametrize("name", ["estimate on workers", "map on workers"])
def test_killed_workers_cost_nothing(name: str, world: Path) -> None:
    line, written = RUNS[name]
    whole, seconds = unbroken(name, world)
    clean(world)
    killed = 0
    with started(line.split(), world) as process:
        deadline = time.monotonic() + 20 * seconds + 60
        while process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.3 * seconds / 10 + 0.2)
            below = [pid for pid in descendants(process.pid) if b"spawn_main" in cmdline(pid)]
            if killed < 10 and below:
                os.kill(random.Random(killed).choice(below), signal.SIGKILL)
                killed += 1
        said = process.communicate()[1]
    assert process.returncode in (0, 3), said
    assert killed >= (2 if MANY == 1 else 10)
    if name.startswith("map"):
        assert_same_map(json.loads((world / written).read_bytes()), json.loads(whole))
    else:
        pairs = zip(*(json.loads(text)["scans"] for text in ((world / written).read_bytes(), whole)), strict=True)
        lost = [found for found, expected in pairs if not same_to_rounding(found, expected)]
        assert all("its worker was killed twice" in found["reason"] for found in lost)  # so it happened to be
        assert len(lost) <= killed // 2
    clean(world)


def same_to_rounding(found: object, expected: object) -> bool:
    """Whether two entries are the same to rounding: a chunk whose worker was killed twice is done file by file."""
    if isinstance(found, dict) and isinstance(expected, dict):
        return found.keys() == expected.keys() and all(same_to_rounding(found[key], expected[key]) for key in found)
    if isinstance(found, list) and isinstance(expected, list):
        return len(found) == len(expected) and all(map(same_to_rounding, found, expected))
    if isinstance(found, float) and isinstance(expected, float):
        return found == pytest.approx(expected, rel=1e-6, abs=1e-9)
    return found == expected


def cmdline(pid: int) -> bytes:
    """Command line of a process, empty where it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def test_a_second_run_on_the_same_output_is_refused(world: Path) -> None:
    clean(world)
    line = RUNS["estimate"][0].split()
    with started(line, world) as first:
        deadline = time.monotonic() + 60
        while not (world / "a.json.journal").exists() and time.monotonic() < deadline and first.poll() is None:
            time.sleep(0.01)
        second = subprocess.run(command(*line), cwd=world, env=environment(), capture_output=True, text=True)
        if first.poll() is None:
            assert second.returncode == 2
            assert "in use: another run writes the same output" in second.stderr
    clean(world)
