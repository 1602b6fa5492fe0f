"""Edge points: both ends of each ring, whatever the direction, the gaps and the number of revolutions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import EstimationError, Scan
from optshape_graph.edges import DOWN, LEFT, RIGHT, UP, extract_edge_points, with_top_and_bottom
from optshape_graph.io import load_sensor
from optshape_graph.ring_returns import RingReturns


def wall(azimuths: np.ndarray, ring: int, distance: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    """Returns of one ring on a cylinder about the sensor."""
    points = np.column_stack(
        [distance * np.cos(azimuths), distance * np.sin(azimuths), np.full(len(azimuths), 0.1 * ring)]
    )
    return points, np.full(len(azimuths), ring)


def scan(*rings: tuple[np.ndarray, np.ndarray], sensor: str | None = "vlp16") -> Scan:
    return Scan(
        np.vstack([points for points, _ in rings]),
        np.concatenate([ring for _, ring in rings]),
        sensor=load_sensor(sensor) if sensor else None,
    )


@given(st.floats(-np.pi, np.pi), st.integers(0, 2**31 - 1))
def test_ends_in_any_direction(direction: float, seed: int) -> None:
    step = np.radians(0.2)
    rng = np.random.default_rng(seed)
    spans = [(-rng.integers(1, 40), rng.integers(1, 40)) for _ in range(4)]
    rings = [wall(direction + step * np.arange(lo, hi + 1), k) for k, (lo, hi) in enumerate(spans)]
    whole = scan(*rings)
    order = rng.permutation(len(whole))
    edges = extract_edge_points(whole.select(order))
    assert list(edges.ring) == [0, 0, 1, 1, 2, 2, 3, 3]
    assert list(edges.side) == [LEFT, RIGHT] * 4
    for k, (lo, hi) in enumerate(spans):
        # Azimuths are relative to a common reference: widths are what is absolute.
        assert edges.azimuth[2 * k] - edges.azimuth[2 * k + 1] == pytest.approx((hi - lo) * step, abs=1e-9)
    np.testing.assert_array_equal(edges.points, whole.select(order).points[edges.index])
    assert (edges.revolutions == 1).all()


def test_a_ring_with_one_return_has_both_ends_there() -> None:
    edges = extract_edge_points(scan(wall(np.radians([1.0]), 0), wall(np.radians([0.8, 1.0, 1.2]), 1)))
    np.testing.assert_array_equal(edges.points[0], edges.points[1])
    assert list(edges.side[:2]) == [LEFT, RIGHT]


def test_gaps_do_not_end_a_ring() -> None:
    azimuths = np.radians(0.2 * np.array([0, 1, 2, 6, 7, 8]))
    edges = extract_edge_points(scan(wall(azimuths, 0), wall(azimuths, 1)))
    assert edges.n_rings == 2
    assert edges.azimuth[0] - edges.azimuth[1] == pytest.approx(np.radians(1.6))


def test_two_revolutions_merged() -> None:
    step = np.radians(0.2)
    merged = np.concatenate([step * np.arange(20), step * (np.arange(20) + 0.4)])
    edges = extract_edge_points(scan(wall(merged, 0), wall(merged, 1)))
    assert (edges.revolutions == 2).all()


def test_the_step_is_estimated_where_it_is_not_stated() -> None:
    azimuths = np.radians(0.33 * np.arange(12))
    edges = extract_edge_points(scan(wall(azimuths, 0), wall(azimuths, 1), sensor=None))
    assert edges.azimuth_step == pytest.approx(np.radians(0.33))


def test_no_step_to_be_found() -> None:
    with pytest.raises(EstimationError, match="azimuth step"):
        extract_edge_points(scan(wall(np.array([0.0]), 0), wall(np.array([0.0]), 1), sensor=None))


def test_no_rings() -> None:
    with pytest.raises(EstimationError, match="rings"):
        extract_edge_points(Scan(np.ones((5, 3))))


@given(st.floats(-1.0, 1.0), st.floats(-0.5, 0.5))
def test_outward_is_the_derivative_along_the_ring(azimuth: float, tilt: float) -> None:
    """Against the intersection of turned rays with the plane, by central differences."""
    normal = np.array([np.cos(tilt), np.sin(tilt), 0.2])
    normal /= np.linalg.norm(normal)

    def hit(angle: float) -> np.ndarray:
        ray = np.array([np.cos(angle), np.sin(angle), 0.1])
        return ray * 5.0 / (normal @ ray)

    points = np.array([hit(azimuth), hit(azimuth - 0.01)])
    edges = extract_edge_points(Scan(points, np.array([0, 0]), sensor=load_sensor("vlp16")))
    h = 1e-6
    numerical = (hit(azimuth + h) - hit(azimuth - h)) / (2 * h)
    np.testing.assert_allclose(edges.outward(normal)[0], numerical, rtol=1e-5, atol=1e-6)


def test_top_and_bottom_are_bounded_by_the_next_rings() -> None:
    sensor = load_sensor("vlp16")

    def ring(k: int, n: int) -> tuple[np.ndarray, np.ndarray]:
        azimuths, elevation = np.radians(0.2 * np.arange(n)), sensor.elevations[k]
        ray = np.column_stack([np.cos(azimuths), np.sin(azimuths), np.full(n, np.tan(elevation))])
        return 5.0 * ray, np.full(n, k)

    cloud = scan(ring(6, 5), ring(7, 9), ring(8, 3))
    edges = extract_edge_points(cloud)
    more = with_top_and_bottom(edges, RingReturns.of([cloud]))
    assert len(more) == len(edges) + 2
    assert list(more.side[-2:]) == [UP, DOWN]
    assert list(more.ring[-2:]) == [8, 6]
    np.testing.assert_allclose(more.width[-2:], np.radians(2.0))
    # The middle of its ring; and moving up raises it.
    np.testing.assert_allclose(more.points[-2], ring(8, 3)[0][1])
    assert more.sweep[-2, 2] > 0
    assert more.sweep[-1, 2] < 0
    top = scan(ring(14, 5), ring(15, 5))
    assert list(with_top_and_bottom(extract_edge_points(top), RingReturns.of([top])).side[8 - 4 :]) == [DOWN]
    unknown = scan(ring(6, 5), ring(7, 9), sensor=None)
    ends = extract_edge_points(unknown)
    assert with_top_and_bottom(ends, RingReturns.of([unknown])) is ends


def test_ends_that_are_parted_from_their_ring_may_be_strays() -> None:
    """The boundary may be anywhere across the gap beside the outermost two returns, and beyond as for any other end."""
    step = np.radians(0.2)
    steps = np.array([0.0, 4.0, 5.0, 6.0, 7.0, 8.0, 12.0, 13.0])  # one return parted on the right, two on the left
    azimuth = steps * step
    points = 5.0 * np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(8)])
    edges = extract_edge_points(Scan(points, np.zeros(8, int), sensor=load_sensor("vlp16").with_azimuth_step(step)))
    assert (-edges.lower / step).round(6).tolist() == [5.0, 4.0]
    assert (edges.upper / step).round(6).tolist() == [1.0, 1.0]
