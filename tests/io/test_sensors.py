"""Sensor files: built-in, saved and read back, and refused."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError, SensorModel
from optshape_graph.io import load_sensor, save_sensor
from optshape_graph.io.builtin import builtin_names
from tests.shared import SHARED, needs_shared

SENSOR = """\
schema: optshape/sensor/1
name: mine
elevations_deg: [-2, 0, 2]
azimuth_step_deg: 0.2
range_noise_m: 0.01
"""


@st.composite
def sensors(draw: st.DrawFn) -> SensorModel:
    n = draw(st.integers(1, 40))
    gaps = np.array(draw(st.lists(st.floats(1e-3, 0.03), min_size=n, max_size=n)))
    small = st.floats(0, 1)
    least = draw(small)
    return SensorModel(
        elevations=np.cumsum(gaps) - draw(st.floats(0, 1.2)),
        name=draw(st.text(min_size=1, max_size=8)),
        azimuth_step=draw(st.none() | st.floats(1e-4, 1)),
        range_noise=draw(small),
        ring_bias=draw(small),
        brightness_bias=draw(small),
        blooming=draw(small),
        odd_ends=draw(st.floats(1e-6, 0.999)),
        beam_divergence=draw(small),
        beam_aperture=draw(small),
        azimuth_offsets=draw(st.none() | st.lists(st.floats(-0.2, 0.2), min_size=n, max_size=n).map(np.array)),
        range_bias=draw(st.none() | st.lists(st.floats(-0.1, 0.1), min_size=n, max_size=n).map(np.array)),
        elevation_sd=draw(st.none() | st.lists(small, min_size=n, max_size=n).map(np.array)),
        firing_phases=(phases := draw(st.none() | st.lists(st.floats(0, 0.99), min_size=n, max_size=n).map(np.array))),
        firing_sd=None if phases is None else draw(st.none() | st.lists(small, min_size=n, max_size=n).map(np.array)),
        firing_period=draw(st.floats(1e-6, 1e-3)),
        range_trend_sd=draw(small),
        elevation_trend_sd=draw(small),
        azimuth_trend_sd=draw(small),
        edge_offset=draw(st.floats(-0.5, 0.5)),
        edge_offset_sd=draw(small),
        range_resolution=draw(small),
        min_range=least,
        max_range=draw(st.just(np.inf) | st.floats(least + 1, 500)),
    )


@given(sensors())
def test_saved_is_loaded(tmp_path_factory: pytest.TempPathFactory, sensor: SensorModel) -> None:
    path = tmp_path_factory.mktemp("sensor") / "a.yaml"
    save_sensor(path, sensor)
    found = load_sensor(path)
    for name in (
        "range_bias", "elevation_sd", "edge_offset", "edge_offset_sd",
        "elevations", "azimuth_step", "range_noise", "ring_bias", "beam_divergence", "azimuth_offsets",
        "range_resolution", "min_range", "max_range", "brightness_bias", "blooming", "odd_ends",
        "range_trend_sd", "elevation_trend_sd", "azimuth_trend_sd",
    ):  # fmt: skip
        value = getattr(sensor, name)
        if value is None:
            assert getattr(found, name) is None
        else:  # radians become degrees and back
            np.testing.assert_allclose(getattr(found, name), value, rtol=1e-15, atol=1e-16)
    for name in ("firing_phases", "firing_sd"):  # in the file they are times
        if getattr(sensor, name) is not None:
            np.testing.assert_allclose(getattr(found, name), getattr(sensor, name), rtol=1e-12, atol=1e-15)
            assert found.firing_period == pytest.approx(sensor.firing_period, rel=1e-12)
    assert found.name == sensor.name


@pytest.mark.parametrize("name", builtin_names("sensor"))
def test_built_in_sensors(name: str) -> None:
    assert load_sensor(name).name == name


def test_what_may_be_left_out(tmp_path: Path) -> None:
    (tmp_path / "os.yaml").write_text("schema: optshape/sensor/1\nelevations_deg: [-1.5, 1e-3]\n")
    sensor = load_sensor("os.yaml", tmp_path)
    assert (sensor.name, sensor.azimuth_step, sensor.azimuth_offsets, sensor.max_range) == ("os", None, None, np.inf)
    np.testing.assert_allclose(np.degrees(sensor.elevations), [-1.5, 1e-3])


@needs_shared
def test_published_tables() -> None:
    with (SHARED / "reference" / "vlp32c_elevations.csv").open() as stream:
        nominal = [float(row["elevation_deg"]) for row in csv.DictReader(stream)]
    np.testing.assert_allclose(np.degrees(load_sensor("vlp32c").elevations), nominal, atol=1e-12)
    reference = load_sensor(SHARED / "reference" / "reference_simulator.sensor.yaml")
    assert reference.n_rings == 32
    np.testing.assert_allclose(np.degrees(reference.azimuth_step or 0), 0.4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            SENSOR.replace("elevations_deg", "elevations"),
            r"bad\.yaml:3: elevations: unknown key 'elevations' \(did you mean 'elev",
        ),
        ("schema: optshape/sensor/1\n", "the key 'elevations_deg' is missing"),
        (SENSOR.replace("sensor/1", "target/1"), r"bad\.yaml:1: schema: expected 'optshape/sensor/1'"),
        (SENSOR.replace("[-2, 0, 2]", "[]"), "elevations_deg: expected a list of 1 or more elements, found 0"),
        (SENSOR.replace("[-2, 0, 2]", "[-2, 2, 0]"), r"number 2 \(0 deg\) does not exceed number 1 \(2 deg\)"),
        (
            SENSOR.replace("[-2, 0, 2]", "[-2, 0, 95]"),
            r"elevations_deg\[2\]: expected a finite number above -90 and below 90, found 95",
        ),
        (
            SENSOR.replace("[-2, 0, 2]", "[-2, low, 2]"),
            r"elevations_deg\[1\]: expected a finite number above -90 and below 90, found 'low'",
        ),
        (SENSOR.replace("0.2", "0"), r"azimuth_step_deg: expected a finite number above 0 and below 180, found 0"),
        (SENSOR + "odd_ends: 1\n", r"bad\.yaml:6: odd_ends: expected a finite number above 0 and below 1, found 1"),
        (SENSOR + "blooming_deg: -1\n", r"bad\.yaml:6: blooming_deg: expected a finite number of at least 0, found -1"),
        (SENSOR.replace("0.01", "-0.01"), r"range_noise_m: expected a finite number of at least 0, found -0\.01"),
        (
            SENSOR.replace("0.01", "1 cm"),
            r"bad\.yaml:5: range_noise_m: expected a finite number of at least 0, found '1 cm'",
        ),
        (SENSOR + "range_bias_m: [1, 2]\n", "expected 3 finite range biases, one per ring, found 2"),
        (SENSOR + "azimuth_offsets_deg: [1, 2]\n", "expected 3 finite azimuth offsets, one per ring, found 2"),
        (SENSOR + "min_range_m: 5\nmax_range_m: 4\n", r"max_range 4\.0 m does not exceed 5\.0 m"),
        (SENSOR + "range_resolution_m: -1\n", r"range_resolution_m: expected a finite number of at least 0, found -1"),
        (SENSOR + "min_range_m: -1\n", r"min_range_m: expected a finite number of at least 0, found -1"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as raised:
        load_sensor(path)
    assert str(raised.value).startswith(str(path))


def test_neither_name_nor_file() -> None:
    with pytest.raises(
        InputError, match=r"vlp64: no such file, and the built-in sensors are: hdl32e, .*vlp32c, vls128, xt32"
    ):
        load_sensor("vlp64")
