"""The truth beside a simulated cloud."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optshape_graph.io import load_sensor, load_target
from optshape_graph.simulation import NoiseModel, Patch, Scene, pose_from_rpy, simulate
from optshape_graph.simulation.truth import write_simulation


@pytest.mark.parametrize("calibrated", [False, True])
def test_noise_of_a_calibrated_sensor_is_named(calibrated: bool, tmp_path: Path) -> None:
    sensor = load_sensor("vlp16")
    if calibrated:
        sensor = replace(sensor, name="mine", range_bias_sd=np.full(sensor.n_rings, 0.002))
    noise = NoiseModel.of(sensor)
    T = pose_from_rpy([5.0, 0.0, 0.0], [0.1, 0.2, 0.1])
    simulated = simulate(Scene((Patch(load_target("paper"), T),)), sensor, noise=noise, rng=0)
    truth = json.loads(write_simulation(tmp_path / "one.pcd", simulated, noise, 0).read_text())
    assert truth["noise"]["rings"] == ("mine" if calibrated else None)
    np.testing.assert_allclose(truth["T_lidar_target"], T)
