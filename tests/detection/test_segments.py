"""Ring segments: what is cut, what is not, and what cannot be used."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optshape_graph import EstimationError, InputError, Scan, Target
from optshape_graph.detection import DetectionOptions
from optshape_graph.detection.segments import Borders, find_borders, find_runs, order_scan
from optshape_graph.io import load_sensor, load_target
from optshape_graph.simulation import Box, Patch, Surface
from tests.detection.scenes import BOARD, plain, pose, scan_of

VLP32C, SQUARE = load_sensor("vlp32c"), load_target("square@1")
OPTIONS = DetectionOptions()


def ring_scan(ranges: np.ndarray, azimuth: np.ndarray, n_rings: int = 2) -> Scan:
    """The same ranges on a few rings."""
    elevation = np.repeat(VLP32C.elevations[:n_rings], len(ranges))
    r, a = np.tile(ranges, n_rings), np.tile(azimuth, n_rings)
    points = r[:, None] * np.column_stack(
        [np.cos(elevation) * np.cos(a), np.cos(elevation) * np.sin(a), np.sin(elevation)]
    )
    return Scan(points, ring=np.repeat(np.arange(n_rings), len(ranges)), sensor=VLP32C)


AZIMUTH = np.radians(0.2) * np.arange(60)


def test_a_slanted_wall_is_one_segment() -> None:
    """From 60 to 72 degrees of incidence neighbouring ranges differ by up to 0.16 m, 16 times the noise."""
    ranges = 10.0 * np.cos(np.radians(60)) / np.cos(AZIMUTH + np.radians(60))
    assert np.diff(ranges).max() == pytest.approx(0.16, abs=0.01)
    assert len(order_scan(ring_scan(ranges, AZIMUTH), OPTIONS).first) == 2


@pytest.mark.parametrize("step", [0.1, -0.1])
def test_a_jump_of_ten_centimetres_is_cut(step: float) -> None:
    ranges = np.where(np.arange(60) < 30, 8.0, 8.0 + step)
    found = order_scan(ring_scan(ranges, AZIMUTH), OPTIONS)
    np.testing.assert_array_equal(found.first % 60, [0, 30, 0, 30])


def test_a_crease_is_not_a_jump() -> None:
    ranges = 8.0 + np.where(np.arange(60) < 30, 0.0, 0.02 * (np.arange(60) - 29))
    assert len(order_scan(ring_scan(ranges, AZIMUTH), OPTIONS).first) == 2


@pytest.mark.parametrize(("lost", "segments"), [(3, 2), (5, 4)])
def test_lost_returns(lost: int, segments: int) -> None:
    keep = np.r_[0:20, 20 + lost : 60]
    assert len(order_scan(ring_scan(np.full(len(keep), 5.0), AZIMUTH[keep]), OPTIONS).first) == segments


def test_every_return_is_in_one_segment() -> None:
    simulated = scan_of(plain(VLP32C), [(BOARD, pose(4, 1, 0))])
    found = order_scan(simulated.scan, OPTIONS)
    np.testing.assert_array_equal(np.sort(found.index), np.arange(len(simulated.scan)))
    np.testing.assert_array_equal(found.points, simulated.scan.points[found.index])
    assert (np.diff(found.segment) >= 0).all()
    assert (found.ring[found.first] == found.ring[found.last]).all()


def test_an_unknown_sensor_is_looked_at() -> None:
    scan = scan_of(plain(VLP32C), [(BOARD, pose(4, 1, 0))]).scan
    found = order_scan(Scan(scan.points, ring=scan.ring), OPTIONS)
    assert found.resolution.step == pytest.approx(np.radians(0.2), rel=0.01)
    np.testing.assert_allclose(found.elevations, VLP32C.elevations, atol=1e-6)


def test_what_cannot_be_used() -> None:
    points = np.array([[5.0, 0.0, 0.0], [5.0, 0.1, 0.0], [5.0, 0.2, 0.0]])
    with pytest.raises(InputError, match="expected a ring"):
        order_scan(Scan(points), OPTIONS)
    with pytest.raises(EstimationError, match="1 rings"):
        order_scan(Scan(points, ring=np.zeros(3, int), sensor=VLP32C), OPTIONS)
    with pytest.raises(EstimationError, match="0 rings"):
        order_scan(Scan(np.zeros((0, 3)), ring=np.zeros(0, int), sensor=VLP32C), OPTIONS)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 8.0))
def test_near_finds_what_a_look_at_every_return_would(seed: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    azimuth = np.append(rng.uniform(-np.pi, np.pi, 300), [np.pi, -np.pi, 0.0])  # the seam, from either side
    ordered = order_scan(ring_scan(rng.uniform(1.0, 8.0, len(azimuth)), azimuth, 5), OPTIONS)
    centre = ordered.points[rng.integers(len(ordered))] + rng.normal(0.0, 0.5, 3)
    expected = np.flatnonzero(((ordered.points - centre) ** 2).sum(axis=1) < reach**2)
    np.testing.assert_array_equal(ordered.near(centre, reach), expected)


def ends_of_panel(*things: Surface) -> Borders:
    simulated = scan_of(plain(VLP32C), [(SQUARE, pose(6, 0, 0))], *things)
    ordered = order_scan(simulated.scan, OPTIONS)
    return find_borders(ordered, find_runs(ordered, np.flatnonzero(simulated.surface[ordered.index] == 0)).ends)


def test_free_ends() -> None:
    ends = ends_of_panel()
    assert ends.open.mean() > 0.95
    assert not ends.hidden.any()


def test_ends_at_sides_that_bend_away() -> None:
    side = Target.from_polygon([[0, 0], [0.2, 0], [0.2, 1], [0, 1]], "side")
    back, out = 0.1 * np.sin(np.radians(30)), 0.5 + 0.1 * np.cos(np.radians(30))
    bay = [Patch(side, pose(6 + back, sign * out, 0, 0, 0, -30 * sign)) for sign in (-1, 1)]
    ends = ends_of_panel(*bay)
    assert ends.open.mean() < 0.1
    assert not ends.hidden.any()


def test_ends_at_a_post_before_one_side() -> None:
    ends = ends_of_panel(Box(np.array([0.1, 0.3, 3.0]), pose(5, 0.45, 0)))
    left, right = np.split(ends.hidden, 2)
    assert {left.mean() > 0.95, right.mean() > 0.95} == {True, False}
    assert not (ends.open & ends.hidden).any()
