"""The sensor model: its checks, and the nearest ring."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError, SensorModel
from optshape_graph.io import load_sensor


@given(st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=50))
def test_nearest_ring(elevations: list[float]) -> None:
    sensor = load_sensor("vlp32c")
    nearest = np.abs(np.array(elevations)[:, None] - sensor.elevations).min(axis=1)
    found = np.abs(np.array(elevations) - sensor.elevations[sensor.nearest_ring(elevations)])
    np.testing.assert_allclose(found, nearest, atol=1e-15)


def test_one_ring() -> None:
    assert list(SensorModel(np.array([0.1])).nearest_ring([0.0, 1.0])) == [0, 0]


def test_step_can_be_replaced() -> None:
    assert load_sensor("vlp16").with_azimuth_step(0.01).azimuth_step == 0.01


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"elevations": []}, "finite elevations"),
        ({"elevations": [0.0, np.nan]}, "finite elevations"),
        ({"elevations": [0.1, 0.0]}, "lowest ring up"),
        ({"elevations": [0.0, 0.0]}, "lowest ring up"),
        ({"elevations": [0.0, 2.0]}, "90 deg"),
        ({"elevations": [0.0], "range_noise": -1.0}, "range_noise"),
        ({"elevations": [0.0], "ring_bias": np.inf}, "ring_bias"),
        ({"elevations": [0.0], "beam_aperture": -0.1}, "beam_aperture"),
        ({"elevations": [0.0], "azimuth_step": 0.0}, "azimuth step"),
        ({"elevations": [0.0], "azimuth_step": 4.0}, "azimuth step"),
        ({"elevations": [0.0], "min_range": 5.0, "max_range": 4.0}, "max_range"),
        ({"elevations": [0.0, 0.1], "azimuth_offsets": [0.0]}, "azimuth offsets"),
    ],
)
def test_what_is_no_sensor(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        SensorModel(**arguments)


def test_sensors_are_equal_by_value() -> None:
    sensor = load_sensor("vlp16")
    assert sensor == load_sensor("vlp16")
    assert hash(sensor) == hash(load_sensor("vlp16"))
    assert sensor not in {load_sensor("vlp32c"), sensor.with_azimuth_step(0.01)}
    assert sensor != SensorModel(sensor.elevations)
    assert not pickle.loads(pickle.dumps(sensor)).elevations.flags.writeable


def test_a_sensor_prints_as_one_line() -> None:
    assert repr(load_sensor("vlp16")) == "SensorModel('vlp16', 16 rings, -15 to 15 deg)"
