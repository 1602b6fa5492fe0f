"""Targets in scan after scan: what the tracker finds is what a search of the whole scan finds."""

import numpy as np
import pytest

import optshape_graph.detection.tracker as module
from optshape_graph import InputError, Scan, load_sensor, load_target
from optshape_graph.detection import DetectionOptions, TargetTracker, detect_targets
from tests.detection.scenes import pose, scan_of

PAPER, SQUARE = load_target("paper@1"), load_target("square@1")
SENSOR = load_sensor("vlp32c")


def drive(k: int, targets: int = 2) -> Scan:
    """Scan k of a sensor that passes two targets at 2 m/s and turns by half a radian per second."""
    forward, turned = 0.2 * k, -np.degrees(0.05) * k
    away = pose(0, 0, 0, 0, 0, turned) @ pose(-forward, 0, 0)
    placed = [(PAPER, away @ pose(7, 1, 0, 20, 10, 15)), (SQUARE, away @ pose(3, -6, 0, 50, 5, -80))]
    return scan_of(SENSOR, placed[:targets], seed=k).scan


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Returns that were looked at, search by search."""
    sizes: list[int] = []

    def counted(scan: Scan, targets: object, options: DetectionOptions) -> object:
        sizes.append(len(scan))
        return detect_targets(scan, targets, options)  # type: ignore[arg-type]  # as given

    monkeypatch.setattr(module, "detect_targets", counted)
    return sizes


def test_a_drive_is_followed_and_poses_are_those_of_whole_scans(searched: list[int]) -> None:
    tracker, scans = TargetTracker([PAPER, SQUARE], everywhere_every=5), [drive(k) for k in range(6)]
    for k, scan in enumerate(scans):
        tracked, whole = tracker.find(scan, 0.1 * k), detect_targets(scan, [PAPER, SQUARE])
        assert [one.target.name for one in tracked.found] == [one.target.name for one in whole.found]
        assert tracked.found
        for mine, its in zip(tracked.found, whole.found, strict=True):
            np.testing.assert_array_equal(mine.indices, its.indices)
            np.testing.assert_allclose(mine.estimate.T_lidar_target, its.estimate.T_lidar_target, atol=1e-9)
    assert [size == len(scan) for size, scan in zip(searched, scans, strict=True)] == [True, *[False] * 4, True]
    assert max(searched[1:5]) < 0.5 * len(scans[0])


def test_a_target_that_is_lost_is_looked_for_everywhere_at_once(searched: list[int]) -> None:
    tracker = TargetTracker([PAPER, SQUARE])
    assert len(tracker.find(drive(0)).found) == 2
    assert [one.target for one in tracker.find(drive(1, targets=1)).found] == [PAPER]
    assert len(searched) == 3, "about both, then everywhere"
    assert [one.target for one in tracker.find(drive(2, targets=1)).found] == [PAPER]
    assert len(searched) == 4


def test_a_target_that_appears_is_found_by_the_next_whole_search() -> None:
    tracker = TargetTracker([PAPER, SQUARE], everywhere_every=3)
    counts = [len(tracker.find(drive(k, targets=1 + (k > 0))).found) for k in range(4)]
    assert counts == [1, 1, 1, 2]


def test_times_and_limits_that_cannot_be() -> None:
    tracker = TargetTracker(PAPER)
    tracker.find(drive(0, 1), 5.0)
    with pytest.raises(InputError, match=r"stamp 5\.0 is not after 5\.0"):
        tracker.find(drive(1, 1), 5.0)
    with pytest.raises(InputError, match="expected at least 1"):
        TargetTracker(PAPER, everywhere_every=0)
    with pytest.raises(InputError, match="limits >= 0"):
        TargetTracker(PAPER, speed=float("nan"))
