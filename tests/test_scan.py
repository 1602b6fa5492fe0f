"""The scan: fields of one length, finite points, selection of all fields together."""

import numpy as np
import pytest

from optshape_graph import InputError, Scan
from optshape_graph.scan import without_duplicates


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
    ],
)
def test_what_is_no_scan(points: np.ndarray, ring: np.ndarray | None, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Scan(points, ring)


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
