"""Full scans that are searched together: as one by one, of several sensors, with targets of their own."""

import numpy as np
import pytest

from optshape_graph import InputError, Scan, Target
from optshape_graph.detection import Search, detect_in_scans, detect_targets
from optshape_graph.io import load_sensor, load_target
from tests.detection.scenes import pose, scan_of

PAPER, SQUARE, TRIANGLE = (load_target(f"{name}@1") for name in ("paper", "square", "triangle"))


def searches() -> list[Search]:
    """Scans of two sensors with two targets, one, and none; all shapes looked for, one, and one that isn't there."""
    vlp32c, os1 = load_sensor("vlp32c"), load_sensor("os1-64")
    two = [(PAPER, pose(6, 0, 0.1, 20, 10, 15)), (TRIANGLE, pose(0.5, 7, 0, 15, 0, 80))]
    return [
        Search(scan_of(vlp32c, two, seed=1).scan, [PAPER, SQUARE, TRIANGLE]),
        Search(scan_of(os1, two[:1], seed=2).scan, PAPER),
        Search(scan_of(vlp32c, [], seed=3).scan, (PAPER,)),
        Search(scan_of(vlp32c, two[1:], seed=4).scan, [SQUARE]),
    ]


def test_as_one_by_one() -> None:
    """The same targets by the same returns; poses differ by rounding of what is solved side by side."""
    asked = searches()
    together = detect_in_scans(asked)
    assert [len(of_scan.found) for of_scan in together] == [2, 1, 0, 0]
    for search, of_scan in zip(asked, together, strict=True):
        alone = detect_targets(search.scan, search.targets)
        assert of_scan.scan == alone.scan == search.scan.name
        assert [one.reason for one in of_scan.rejected] == [one.reason for one in alone.rejected]
        for one, other in zip(of_scan.found, alone.found, strict=True):
            assert (one.target.name, one.status, one.reason) == (other.target.name, other.status, other.reason)
            np.testing.assert_array_equal(one.indices, other.indices)
            np.testing.assert_allclose(one.estimate.T_lidar_target, other.estimate.T_lidar_target, atol=1e-7)
            assert one.score == pytest.approx(other.score, abs=1e-6)


def test_an_error_is_of_its_own_scan() -> None:
    good = searches()[1]
    millimetres = Scan(1e3 * good.scan.points, ring=good.scan.ring, name="mm")
    nothing_wanted: list[Target] = []
    wrong = [Search(Scan(good.scan.points), PAPER), Search(millimetres, PAPER), Search(good.scan, nothing_wanted)]
    *refused, found = detect_in_scans([*wrong, good])
    for search, error in zip(wrong, refused, strict=True):
        assert isinstance(error, InputError)
        with pytest.raises(InputError) as alone:
            detect_targets(search.scan, search.targets)
        assert str(error) == str(alone.value)
    assert len(found.found) == 1


def test_no_scans() -> None:
    assert detect_in_scans([]) == []
