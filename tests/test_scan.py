"""The scan: fields of one length, finite points, selection of all fields together."""

import numpy as np
import pytest
from numpy.typing import ArrayLike

from optshape_graph import (
    EstimationError,
    InputError,
    Scan,
    SensorModel,
    detect_targets,
    estimate_pose,
    load_sensor,
    load_target,
)
from optshape_graph.scan import not_in_metres, rings_from_the_top, without_duplicates
from optshape_graph.simulation import pose_from_rpy, simulate_target


def test_select_keeps_fields_together() -> None:
    scan = Scan(np.arange(12.0).reshape(4, 3), np.arange(4), np.arange(4) * 2.0, np.arange(4) * 0.1)
    part = scan.select(np.array([3, 1]))
    assert part.ring is not None
    assert part.intensity is not None
    assert part.time is not None
    assert list(part.ring) == [3, 1]
    assert list(part.intensity) == [6.0, 2.0]
    np.testing.assert_allclose(part.time, [0.3, 0.1])
    np.testing.assert_array_equal(part.points[:, 0], [9.0, 3.0])
    assert len(scan.select(scan.points[:, 0] > 100)) == 0


@pytest.mark.parametrize(
    ("points", "ring", "message"),
    [
        (np.zeros((3, 2)), None, "N x 3"),
        (np.full((2, 3), np.nan), None, "2 points are not finite"),
        (np.zeros((3, 3)), np.zeros(2), "3 points but ring"),
        ([["a", "b", "c"]], None, "points: expected real numbers"),
        ([[1.0, 2.0, 3.0], [1.0]], None, "points: expected real numbers"),
        (np.zeros((2, 3), complex), None, "points: expected real numbers"),
        (np.zeros((2, 3)), [0, np.nan], "ring numbers as integers from 0, found nan"),
        (np.zeros((2, 3)), [0, 1.5], r"ring numbers as integers from 0, found 1\.5"),
        (np.zeros((2, 3)), [0, -1], "ring numbers as integers from 0, found -1"),
        (np.zeros((2, 3)), ["0", "b"], "ring: expected real numbers"),
    ],
)
@pytest.mark.filterwarnings("error")  # NumPy's casts
def test_what_is_no_scan(points: ArrayLike, ring: ArrayLike | None, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Scan(points, ring)  # type: ignore[arg-type]  # on purpose


def test_rings_are_those_of_the_sensor() -> None:
    sensor = SensorModel(np.radians([-1.0, 0.0, 1.0]), name="three")
    assert Scan(np.ones((2, 3)), [0.0, 2.0], sensor=sensor).ring.tolist() == [0, 2]  # type: ignore[arg-type, union-attr]
    with pytest.raises(InputError, match="ring 3, but sensor 'three' has 3, counted from 0 for the lowest"):
        Scan(np.ones((2, 3)), np.array([0, 3]), sensor=sensor)


@pytest.mark.parametrize(
    ("factor", "shift", "found"),
    [(1000.0, 0.0, "expected metres"), (1.0, 4e5, "coordinates of a map"), (10.0, 0.0, "")],
)
def test_millimetres_are_told(factor: float, shift: float, found: str) -> None:
    around = np.linspace(0, 2 * np.pi, 50)
    points = factor * np.column_stack([6 * np.cos(around), 6 * np.sin(around), 0 * around]) + shift
    assert found in not_in_metres(points)
    assert bool(not_in_metres(points)) == bool(found)


def test_scans_are_equal_by_value() -> None:
    points = np.arange(12.0).reshape(4, 3)
    scan = Scan(points, ring=[0, 0, 1, 1], name="a")
    assert scan == Scan(points, ring=[0, 0, 1, 1], name="a")
    assert scan != Scan(points, name="a")
    assert scan != Scan(points + 1e-12, ring=[0, 0, 1, 1], name="a")
    assert repr(scan) == "Scan('a', 4 returns, 2 rings)"


def test_duplicates_are_dropped_once() -> None:
    """Whatever the order; a point on two rings is none."""
    points = np.array([[1.0, 2, 3], [4, 5, 6], [1, 2, 3], [4, 5, 6], [1, 2, 3], [7, 8, 9]])
    once, dropped = without_duplicates(Scan(points, np.array([0, 1, 0, 2, 0, 3])))
    assert dropped == 2
    assert once.points.tolist() == [[1, 2, 3], [4, 5, 6], [4, 5, 6], [7, 8, 9]]
    assert without_duplicates(once) == (once, 0)
    assert without_duplicates(Scan(np.zeros((0, 3))))[1] == 0


def test_rings_counted_from_the_top_are_named() -> None:
    """In memory nothing puts them in order; a pose of them was ok and wrong."""
    scan = simulate_target(load_target("paper"), load_sensor("vlp32c"), pose_from_rpy([6.0, 0.0, 0.0], [0.1, 0.2, 0.3]))
    assert scan.ring is not None
    assert rings_from_the_top(scan) == ""
    turned = Scan(scan.points, scan.ring.max() - scan.ring)
    assert "expected rings that are counted from the lowest elevation" in rings_from_the_top(turned)
    with pytest.raises(EstimationError, match="counted from the lowest"):
        estimate_pose(turned, load_target("paper"))
    with pytest.raises(InputError, match="counted from the lowest"):
        detect_targets(turned, load_target("paper"))
    one = scan.select(scan.ring == np.median(scan.ring))
    with pytest.raises(EstimationError, match="on one ring"):
        estimate_pose(one, load_target("paper"))
