"""The sensor that a cloud's elevations tell: built-in, recorded, and where several come into question."""

from __future__ import annotations

import numpy as np
import pytest

from optshape_graph.io import load_sensor, read_scan
from optshape_graph.io.builtin import builtin_names
from optshape_graph.io.sensor_guess import guess_sensor
from optshape_graph.scan import Scan
from tests.shared import SHARED, needs_shared


def cloud_of(name: str, rows: slice = slice(None), rings: bool = True, tilt: float = 0.0) -> Scan:
    """Returns 10 m away, all round, on some rows of a table; coordinates to a tenth of a millimetre."""
    sensor = load_sensor(name)
    index = np.arange(sensor.n_rings)[rows]
    azimuth, ring = np.meshgrid(np.linspace(-np.pi, np.pi, 60, endpoint=False), index)
    elevation = sensor.elevations[ring] + tilt * np.cos(azimuth)
    points = 10 * np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1
    )
    return Scan(np.round(points.reshape(-1, 3), 4), ring.ravel() if rings else None)


@pytest.mark.parametrize("rings", [True, False])
@pytest.mark.parametrize("name", builtin_names("sensor"))
def test_every_built_in_sensor_is_told(name: str, rings: bool) -> None:
    guess = guess_sensor(cloud_of(name, rings=rings))
    assert next(iter(guess.misfits)) == name
    assert guess.sensor is not None, guess
    assert guess.sensor.name == name
    assert name in str(guess)


def test_what_several_tables_have_in_common_tells_nothing() -> None:
    guess = guess_sensor(cloud_of("vlp32c", slice(14, 20)))
    assert guess.sensor is None
    assert {"vlp32c", "rs32"} <= guess.misfits.keys()
    assert "no built-in table fits beyond doubt; near are " in str(guess)


def test_no_guess_of_a_tilted_cloud_or_of_a_few_rings() -> None:
    assert guess_sensor(cloud_of("vlp16", tilt=np.radians(5), rings=False)).sensor is None
    assert guess_sensor(cloud_of("vlp16", slice(3, 6))).sensor is None
    points = np.random.default_rng(0).normal(0, 5, (500, 3))
    assert guess_sensor(Scan(points)).sensor is None


@pytest.mark.parametrize(
    ("first", "step", "told"),
    [(8, 1, True), (9, 1, True), (0, 1, True), (6, 1, False), (31, -1, True), (29, -1, False)],
)
def test_ring_numbers_of_a_crop_do_not_contradict_the_guess(first: int, step: int, told: bool) -> None:
    """Rings 8 to 29 of 40, counted from the lowest, from 1, from the first seen, and from the highest."""
    crop = cloud_of("pandar40p", slice(8, 30))
    assert crop.ring is not None
    guess = guess_sensor(Scan(crop.points, first + step * (crop.ring - 8)))
    assert (guess.sensor is not None and guess.sensor.name == "pandar40p") == told
    assert "pandar40p" in guess.misfits


@needs_shared
def test_recorded_scans() -> None:
    for path in sorted((SHARED / "data" / "camera" / "scans").glob("*_full.pcd"))[:3]:
        guess = guess_sensor(read_scan(path))
        assert guess.sensor is not None
        assert guess.sensor.name == "vlp16"
    for path in sorted((SHARED / "data" / "mocap" / "session1").glob("*.pcd")):
        guess = guess_sensor(read_scan(path))
        assert guess.sensor is None or guess.sensor.name == "vlp32c"
    unit = guess_sensor(read_scan(SHARED / "data" / "handheld" / "scan00.pcd"))  # a unit with a table of its own
    assert unit.sensor is None
    assert next(iter(unit.misfits)) == "os1-64-gen1"
