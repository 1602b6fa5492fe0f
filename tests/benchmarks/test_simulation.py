"""How fast the analytic simulator is, against the time that the sensor itself takes."""

import time

import numpy as np
import pytest

from optshape_graph.io import load_sensor, load_target
from optshape_graph.simulation import NoiseModel, pose_from_rpy, room, simulate, simulate_target

pytestmark = pytest.mark.benchmark

REVOLUTION_S = 0.1


def seconds(function, runs: int = 50) -> float:
    """Median processor time of a call: it runs on one core, whatever else the machine does."""
    function(0)
    times = []
    for seed in range(runs):
        start = time.process_time()
        function(seed)
        times.append(time.process_time() - start)
    return float(np.median(times))


def test_one_target_is_simulated_twenty_times_faster_than_real_time():
    target, sensor = load_target("paper"), load_sensor("vlp32c")
    noise, pose = NoiseModel.of(sensor), pose_from_rpy([8.0, 0.0, 0.0], np.radians([5, 10, 10]))
    rays = sensor.n_rings * round(2 * np.pi / sensor.azimuth_step)
    assert rays == 57_600
    ratio = REVOLUTION_S / seconds(lambda seed: simulate_target(target, sensor, pose, noise=noise, rng=seed))
    print(f"one target, {rays} rays: {ratio:.0f} x real time")
    assert ratio >= 20


def test_a_full_scene_is_simulated_in_real_time():
    target, sensor = load_target("paper"), load_sensor("vlp32c")
    scene = room([(target, pose_from_rpy([6.0, y, 0.0])) for y in (-3.0, 0.0, 3.0)])
    noise = NoiseModel.of(sensor)
    ratio = REVOLUTION_S / seconds(lambda seed: simulate(scene, sensor, noise=noise, rng=seed), runs=10)
    print(f"room with three targets on stands: {ratio:.1f} x real time")
    assert ratio >= 1
