"""How fast targets are found in full scans, against the time that the sensor takes for one."""

import time

import numpy as np
import pytest

from optshape_graph.detection import DetectionOptions, TargetTracker, detect_targets
from optshape_graph.detection.patches import find_patches
from optshape_graph.detection.segments import order_scan
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate_pose, solve_relaxation
from optshape_graph.simulation import Box, NoiseModel, simulate_target
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


def bare_sdp() -> float:
    target, sensor = load_target("paper"), load_sensor("vlp32c")
    returns = simulate_target(target, sensor, facing(6, 0, 0.3), noise=NoiseModel.of(sensor))
    quadratic = estimate_pose(returns, target).measurement.quadratic()
    return seconds(lambda: solve_relaxation(quadratic))


def facing(distance: float, azimuth: float, roll: float) -> np.ndarray:
    """A pose that faces the sensor but for 12 degrees, rolled."""
    away = pose(distance * np.cos(azimuth), distance * np.sin(azimuth), 0.1, 0, 0, np.degrees(azimuth) + 12)
    return away @ pose(0, 0, 0, np.degrees(roll), 0, 0)


def revolution(sensor: str, targets: int, boxes: int = 0):
    """Targets from 4 to 9 m all around, and boxes on the floor between them."""
    target, rng = load_target("paper"), np.random.default_rng(0)
    bearings = 0.2 + np.arange(targets) * np.pi / 3
    placed = [(target, facing(4.0 + k, bearing, rng.uniform(-3, 3))) for k, bearing in enumerate(bearings)]
    things: list[Box] = []
    while len(things) < boxes:
        distance, azimuth, sides = rng.uniform(2.5, 16), rng.uniform(-np.pi, np.pi), rng.uniform(0.3, [1.4, 1.4, 1.8])
        if np.abs(np.angle(np.exp(1j * (azimuth - bearings)))).min() > 0.22:
            x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
            things.append(Box(sides, pose(x, y, -1.8 + sides[2] / 2, 0, 0, rng.uniform(0, 180))))
    return scan_of(load_sensor(sensor), placed, *things).scan, placed


@pytest.mark.parametrize(("sensor", "most"), [("vlp16", 45), ("vlp32c", 45), ("os1-128", 60)])
def test_six_targets_in_a_revolution(sensor: str, most: float) -> None:
    scan, placed = revolution(sensor, 6)
    target = placed[0][0]
    found = detect_targets(scan, target).found
    places = [T[:3, 3] for _, T in placed]
    hit = [min(np.linalg.norm(one.estimate.T_lidar_target[:3, 3] - at) for one in found) < 0.1 for at in places]
    ratio = seconds(lambda: detect_targets(scan, target), 5) / bare_sdp()
    print(f"{sensor}: {sum(hit)} of 6 found, {len(found) - sum(hit)} else; {ratio:.0f} bare SDPs, {most} asked")
    assert all(hit)
    assert len(found) == 6
    assert ratio <= most


def test_one_target_of_128_rings() -> None:
    scan, placed = revolution("os1-128", 1)
    ratio = seconds(lambda: detect_targets(scan, placed[0][0]), 5) / bare_sdp()
    print(f"one target: {ratio:.0f} bare SDPs, 15 asked")
    assert ratio <= 15


def test_eight_shapes_against_one() -> None:
    scan, _ = revolution("vlp32c", 6)
    names = ("paper", "square", "triangle", "diamond", "optimal", "optimal3", "optimal5", "built")
    shapes = [load_target(f"{name}@1") for name in names]
    one, eight = (seconds(lambda of=of: detect_targets(scan, of), 5) for of in (shapes[:1], shapes))
    print(f"eight shapes, two of them 8 mm apart: {eight / one:.2f} x one, 1.8 asked")
    assert eight <= 1.8 * one


def test_eighty_boxes_against_none() -> None:
    without, placed = revolution("vlp32c", 6)
    among, _ = revolution("vlp32c", 6, boxes=80)
    none, many = (seconds(lambda scan=scan: detect_targets(scan, placed[0][0]), 5) for scan in (without, among))
    print(f"80 boxes: {many / none:.2f} x none, 3 asked")
    assert many <= 3 * none


def test_tracker_against_whole_scans() -> None:
    scan, placed = revolution("os1-128", 1)
    tracker = TargetTracker(placed[0][0], everywhere_every=1000)
    tracker.find(scan)
    ratio = seconds(lambda: tracker.find(scan), 5) / seconds(lambda: detect_targets(scan, placed[0][0]), 5)
    print(f"one target of 128 rings, followed: {ratio:.2f} x a search of the whole scan")
    assert ratio < 1
