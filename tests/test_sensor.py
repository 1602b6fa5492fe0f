"""The sensor model: its checks, and the nearest ring."""

import pickle
from dataclasses import replace

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


def test_put_right_leaves_nothing_to_put_right() -> None:
    table = load_sensor("vlp16")
    sensor = replace(
        table, range_bias=np.full(16, 0.01), elevations=table.elevations + 1e-3, reported_elevations=table.elevations,
        azimuth_offsets=np.full(16, 2e-3), reported_azimuth_offsets=np.zeros(16),
    )  # fmt: skip
    bias, elevation, azimuth = sensor.deviations
    np.testing.assert_allclose([bias[0], elevation[0], azimuth[0]], [0.01, 1e-3, 2e-3], atol=1e-12)
    again = sensor.put_right
    assert all((part == 0).all() for part in again.deviations)
    assert again.put_right is again
    np.testing.assert_array_equal(sensor.as_reported.elevations, table.elevations)
    assert table.put_right is table


def test_how_far_angles_are_off() -> None:
    table = load_sensor("vlp16")
    np.testing.assert_allclose(np.degrees(table.elevation_sds), 0.05)
    plain = SensorModel(np.array([0.0, 0.1]))
    assert (plain.elevation_sds == 0).all()  # a beam without width is a simulator's
    wide = replace(plain, beam_divergence=1e-3)
    np.testing.assert_allclose(np.degrees([wide.elevation_sds[0], wide.azimuth_sds[0]]), [0.1, 0.05])
    fired = replace(table, firing_sd=np.full(16, 0.5))
    np.testing.assert_allclose(np.degrees(fired.azimuth_sds), np.hypot(0.05, 0.1))


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
