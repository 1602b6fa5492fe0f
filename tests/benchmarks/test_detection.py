"""How fast targets are found in full scans, against the time that the sensor takes for one."""

import time

import numpy as np
import pytest

from optshape_graph.detection import DetectionOptions, detect_targets
from optshape_graph.detection.patches import find_patches
from optshape_graph.detection.segments import order_scan
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate_pose
from tests.detection.scenes import pose, scan_of

pytestmark = pytest.mark.benchmark

OPTIONS = DetectionOptions()
REVOLUTION_S = 0.1
CORES = 2


def seconds(function, runs: int = 10) -> float:
    """Median processor time of a call: it runs on one core, whatever else the machine does."""
    function()
    times = []
    for _ in range(runs):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return float(np.median(times))


@pytest.fixture(scope="module")
def scan():
    target = load_target("paper@1")
    placed = [(target, pose(6, 0, 0, 20, 10, 15)), (target, pose(-2, 8, 0, 70, 5, 100))]
    return scan_of(load_sensor("vlp32c"), placed).scan


def test_full_scans_faster_than_real_time_on_two_cores(scan) -> None:
    target = load_target("paper@1")
    found = detect_targets(scan, [target]).found
    assert len(found) == 2
    assert len(scan) > 50_000
    whole = seconds(lambda: detect_targets(scan, [target]))
    cut = seconds(lambda: order_scan(scan, OPTIONS))
    ordered = order_scan(scan, OPTIONS)
    patches = seconds(lambda: find_patches(ordered, 0.2, 1.5))
    poses = sum(seconds(lambda one=one: estimate_pose(scan.select(one.indices), target)) for one in found)
    print(
        f"{len(scan)} returns, two targets: {1e3 * whole:.0f} ms, of which segments {1e3 * cut:.0f}, patches "
        f"{1e3 * patches:.0f}, poses {1e3 * poses:.0f}; {CORES * REVOLUTION_S / whole:.1f} x real time on {CORES} cores"
    )
    assert whole <= CORES * REVOLUTION_S
