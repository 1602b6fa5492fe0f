"""Rings out of whatever a driver numbers its beams by."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError, SensorModel
from optshape_graph._arrays import Floats, Ints
from optshape_graph.io import load_sensor
from optshape_graph.io.clouds.rings import rings_of_elevations, rings_of_ids

VLP32C, VLP16 = load_sensor("vlp32c"), load_sensor("vlp16")
FIRING_ORDER = np.array([0, 2, 4, 6, 8, 10, 12, 14, 1, 3, 5, 7, 9, 11, 13, 15])
"""Row of the table of each of the VLP-16's lasers, as they fire."""


def cloud(elevations: Floats, ring: Ints, distance: float = 10.0, z: float = 0.0) -> Floats:
    """Three returns per entry of `ring`, from beams that start at height z."""
    azimuth = np.tile([-0.3, 0.1, 0.2], len(ring))
    elevation = np.repeat(elevations[ring], 3)
    ranges = distance * (1 + 0.3 * np.arange(len(azimuth)) / len(azimuth))
    directions = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    return ranges[:, None] * directions + [0, 0, z]


def numberings(n: int) -> dict[str, Ints]:
    rows = np.arange(n)
    return {
        "from the bottom": rows,
        "from one": rows + 1,
        "from the top": n - 1 - rows,
        "from the top, from one": n - rows,
    }


@given(st.sets(st.integers(0, 31), min_size=1), st.sampled_from(list(numberings(32))))
def test_any_rings_in_any_numbering_come_out_as_rows_of_the_table(present: set[int], numbering: str) -> None:
    ring = np.array(sorted(present))
    ids = np.repeat(numberings(32)[numbering][ring], 3)
    found = rings_of_ids(cloud(VLP32C.elevations, ring), ids, VLP32C, "cloud")
    assert found is not None
    np.testing.assert_array_equal(found, np.repeat(ring, 3))
    np.testing.assert_array_equal(rings_of_elevations(cloud(VLP32C.elevations, ring), VLP32C, "cloud"), found)


@given(st.permutations(range(16)), st.sets(st.integers(0, 15), min_size=1))
def test_any_order_of_numbers_comes_out_as_rows_of_the_table(order: list[int], present: set[int]) -> None:
    ring = np.array(sorted(present))
    found = rings_of_ids(cloud(VLP16.elevations, ring), np.repeat(np.array(order)[ring], 3), VLP16, "cloud")
    assert found is not None
    np.testing.assert_array_equal(found, np.repeat(ring, 3))


def test_without_a_sensor() -> None:
    ring = np.array([3, 4, 7, 8])
    points = cloud(VLP16.elevations, ring)

    def found(ids: Ints) -> list[int]:
        rings = rings_of_ids(points, np.repeat(ids, 3), None, "cloud")
        assert rings is not None
        return list(rings[::3])

    assert found(ring) == [3, 4, 7, 8]
    assert found(ring + 1) == [4, 5, 8, 9]
    assert found(15 - ring) == [0, 1, 4, 5]
    assert found(np.array([14, 1, 3, 5])) == [0, 1, 2, 3]
    assert found(np.array([1, 14, 3, 5])) == [0, 1, 2, 3]


def test_a_units_own_table_follows_the_numbers() -> None:
    """Units of a model differ from its data sheet by tenths of a degree, here up to 0.7 of a gap."""
    sheet = SensorModel(np.radians(np.linspace(-22.5, 22.5, 128)), "sheet")
    unit = SensorModel(sheet.elevations + np.radians(0.25) * np.sin(np.arange(128) / 5), "unit")
    ring = np.arange(40, 80)
    found = rings_of_ids(cloud(unit.elevations, ring), np.repeat(127 - ring, 3), sheet, "cloud")
    assert found is not None
    np.testing.assert_array_equal(found, np.repeat(ring, 3))


@given(st.floats(5, 40), st.floats(0.0, 0.5), st.integers(0, 2**32 - 1))
def test_noisy_elevations_leave_the_numbers_alone(distance: float, noise_deg: float, seed: int) -> None:
    """A target 1.4 m high, with as much angular noise as simulations have been published with."""
    rng = np.random.default_rng(seed)
    rows = np.flatnonzero(np.abs(VLP32C.elevations) < np.arctan2(0.7, distance))
    ring = np.repeat(rows, int(2000 / distance**2) + 2)
    elevation = VLP32C.elevations[ring] + rng.normal(0, np.radians(noise_deg), len(ring))
    azimuth = rng.uniform(-0.7, 0.7, len(ring)) / distance
    points = distance * np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    for sensor in (VLP32C, None):
        np.testing.assert_array_equal(rings_of_ids(points, ring, sensor, "cloud"), ring)


def test_beams_that_start_above_the_origin() -> None:
    ring = np.arange(16)
    points = cloud(VLP16.elevations, ring, distance=2.0, z=0.036)
    found = rings_of_ids(points, np.repeat(ring, 3), VLP16, "cloud")
    assert found is not None
    np.testing.assert_array_equal(found, np.repeat(ring, 3))
    points = cloud(VLP16.elevations, ring, distance=4.0, z=0.036)
    np.testing.assert_array_equal(rings_of_elevations(points, VLP16, "cloud"), found)


@pytest.mark.parametrize(
    ("ring", "ids", "message"),
    [
        (np.arange(32), np.arange(32), "vlp16: the cloud has 32 rings, the sensor 16"),
        (
            np.arange(16, 25),
            np.arange(16, 25),
            r"ring 20 of the cloud is at 0\.000 deg, the nearest row of the table at -1",
        ),
        (
            np.arange(3),
            np.arange(3),
            r"ring 0 of the cloud is at -25\.000 deg, the nearest row of the table at -15\.000 deg",
        ),
    ],
)
def test_a_table_that_does_not_fit(ring: Ints, ids: Ints, message: str) -> None:
    points = cloud(VLP32C.elevations, ring)
    with pytest.raises(InputError, match=message):
        rings_of_ids(points, np.repeat(ids, 3), VLP16, "cloud")
    with pytest.raises(InputError, match=r"the elevations do not fit the table of vlp16: .* lie between its rows"):
        rings_of_elevations(points, VLP16, "cloud")


def test_two_rings_on_one_row() -> None:
    sensor = SensorModel(np.radians([-2.0, -0.04, 0.04, 2.0]))
    points = cloud(sensor.elevations, np.arange(4))
    with pytest.raises(InputError, match=r"2 rings of the cloud are nearest to 0\.000 deg"):
        rings_of_ids(points, np.repeat([9, 4, 6, 1], 3), SensorModel(np.radians([-2.0, 0.0, 2.0, 4.0])), "cloud")


def test_points_in_another_frame_do_not_fit() -> None:
    ring = np.arange(16)
    pitch = np.radians(20)
    T = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    with pytest.raises(InputError, match="points that are not in the LiDAR's frame"):
        rings_of_ids(cloud(VLP16.elevations, ring) @ T.T, np.repeat(ring, 3), VLP16, "cloud")


def test_lines_that_are_not_rings(caplog: pytest.LogCaptureFixture) -> None:
    """A Livox numbers its lasers, each of which draws a rosette."""
    rng = np.random.default_rng(3)
    points = np.column_stack([np.full(400, 10.0), rng.uniform(-1, 1, 400), rng.uniform(-1, 1, 400)])
    with caplog.at_level(logging.WARNING):
        assert rings_of_ids(points, rng.integers(0, 4, 400), None, "livox") is None
    assert "livox: beam numbers do not follow the elevation; read as a cloud without rings" in caplog.text
    with pytest.raises(InputError, match="the returns of one beam are at many elevations"):
        rings_of_ids(points, rng.integers(0, 4, 400), VLP16, "livox")


def test_one_ring_and_rounded_coordinates() -> None:
    points = np.round(cloud(VLP16.elevations, np.array([8]), distance=20.0), 2)
    assert rings_of_ids(points, np.full(3, 5), None, "cloud") is not None


def test_a_sensor_with_one_ring() -> None:
    sensor = SensorModel(np.array([0.1]))
    points = cloud(sensor.elevations, np.array([0]))
    np.testing.assert_array_equal(rings_of_elevations(points, sensor, "cloud"), [0, 0, 0])
    with pytest.raises(InputError, match="do not fit"):
        rings_of_elevations(points * [1, 1, 2], sensor, "cloud")


def test_firing_order() -> None:
    ring = np.arange(16)
    points = cloud(VLP16.elevations, ring)
    lasers = np.argsort(FIRING_ORDER)
    for sensor in (VLP16, None):
        found = rings_of_ids(points, np.repeat(lasers[ring], 3), sensor, "cloud")
        assert found is not None
        np.testing.assert_array_equal(found, np.repeat(ring, 3))
