"""What frozen dataclasses do alike: equality by value, a short repr, arrays that stay read-only."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import Scan, estimate_pose, load_sensor, load_target, read_scan
from optshape_graph._arrays import LONGEST_REPR
from optshape_graph.io import demo_folder


def test_equal_by_value() -> None:
    assert load_target("paper") == load_target("paper")
    assert hash(load_target("paper")) == hash(load_target("paper"))
    assert load_target("paper") != load_target("built")
    assert load_sensor("vlp32c") == load_sensor("vlp32c")
    assert load_sensor("vlp32c") != replace(load_sensor("vlp32c"), range_noise=0.02)
    assert load_sensor("vlp32c") != load_target("paper")


def test_one_number_makes_a_difference() -> None:
    points = np.zeros((2, 3))
    other = points.copy()
    other[1, 2] = 1e-300
    assert Scan(points) == Scan(points.copy())
    assert Scan(points) != Scan(other)
    assert Scan(points) != Scan(points[:1])
    assert Scan(points) != Scan(points, ring=np.zeros(2, dtype=int))


@pytest.mark.parametrize("again", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy, copy.copy])
def test_copies_are_equal_and_stay_frozen(again: object) -> None:
    scan = read_scan(demo_folder() / "4m.pcd", load_sensor("vlp32c"))
    estimate = estimate_pose(scan, load_target("built"))
    assert callable(again)
    twin = again(estimate)
    assert twin == estimate
    for array in (
        twin.covariance,
        twin.target.vertices,
        twin.target.normals,
        twin.measurement.L,
        twin.edge_points.points,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


def test_nouns_print_in_a_line() -> None:
    scan = read_scan(demo_folder() / "4m.pcd", load_sensor("vlp32c"))
    long = replace(scan, name="a/very/long\nname" * 100)
    for value in (load_target("paper"), load_sensor("vlp32c"), scan, long):
        assert len(repr(value)) <= LONGEST_REPR
        assert "\n" not in repr(value)
