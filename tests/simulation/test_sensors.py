"""Built-in sensor tables."""

import csv

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io.builtin import builtin_names
from optshape_graph.io.sensors import load_sensor
from optshape_graph.simulation import uniform_sensor
from tests.shared import SHARED, needs_shared

RINGS = {
    "hdl32e": 32, "hdl64e": 64, "helios": 32, "os0-32": 32, "os1-32": 32, "os1-64-gen1": 64, "pandar128": 128,
    "pandar40p": 40, "rs16": 16, "vlp16-hires": 16, "vls128": 128, "xt32": 32,
    "os0-64": 64, "os0-128": 128, "os1-64": 64, "os1-128": 128, "os2-64": 64, "os2-128": 128,
    "pandar64": 64, "pandarqt": 64, "rs32": 32, "rs128": 128, "vlp16": 16, "vlp32c": 32,
}  # fmt: skip


@pytest.mark.parametrize("name", RINGS)
def test_built_in_sensors_have_their_rings_and_state_their_source(name):
    sensor = load_sensor(name)
    assert sensor.name == name
    assert sensor.n_rings == RINGS[name]
    assert sensor.azimuth_step is not None


def test_the_list_above_is_complete():
    assert sorted(RINGS) == builtin_names("sensor")


@needs_shared
def test_vlp32c_is_the_published_table():
    with (SHARED / "reference" / "vlp32c_elevations.csv").open() as stream:
        table = [float(row["elevation_deg"]) for row in csv.DictReader(stream)]
    np.testing.assert_allclose(np.degrees(load_sensor("vlp32c").elevations), table, atol=1e-9)


def test_uniform_sensor_spaces_rings_evenly():
    sensor = uniform_sensor(5, -0.2, 0.2, 0.01)
    np.testing.assert_allclose(np.diff(sensor.elevations), 0.1)
    with pytest.raises(InputError, match="at least 2"):
        uniform_sensor(1, 0.0, 0.1, 0.01)
    with pytest.raises(InputError, match="lowest ring up"):
        uniform_sensor(3, 0.2, -0.2, 0.01)
