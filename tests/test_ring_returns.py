"""Returns side by side, ring by ring: the same in whatever order they were recorded, and in whatever company."""

import numpy as np
import pytest

from optshape_graph._arrays import alike
from optshape_graph.ring_returns import RingReturns
from tests.pose.clouds import simulated


@pytest.mark.parametrize("sensor", ["vlp16", "os1-64"])
def test_they_are_sorted_by_ring_and_from_the_left(sensor: str) -> None:
    scan, _ = simulated(5.0, (5.0, 20.0, 10.0), 1, sensor=sensor)
    assert scan.ring is not None
    order = np.random.default_rng(0).permutation(len(scan))
    returns, shuffled = RingReturns.of([scan]), RingReturns.of([scan.select(order)])
    np.testing.assert_array_equal(shuffled.points, returns.points)
    np.testing.assert_array_equal(order[shuffled.row], returns.row)
    np.testing.assert_array_equal(returns.ring, np.unique(scan.ring))
    np.testing.assert_array_equal(returns.rings.each(returns.ring), scan.ring[returns.row])
    falling = np.diff(returns.azimuth) < 0
    assert np.delete(falling, returns.rings.last[:-1]).all()
    (back,) = returns.sorted_scans()
    np.testing.assert_array_equal(back.points, scan.points[returns.row])
    np.testing.assert_array_equal(back.ring, scan.ring[returns.row])


def test_scans_do_not_depend_on_those_beside_them() -> None:
    scans = [simulated(distance, seed=seed)[0] for seed, distance in enumerate((3.0, 8.0, 5.0))]
    together = RingReturns.of(scans)
    for k, scan in enumerate(scans):
        alone = RingReturns.of([scan])
        for name in ("points", "row", "ring", "layout"):
            assert alike(getattr(together.of_scan(k), name), getattr(alone, name)), name
        np.testing.assert_allclose(together.of_scan(k).azimuth, alone.azimuth, atol=1e-14)
        np.testing.assert_allclose(together.reference[k], alone.reference[0], atol=1e-14)


def test_azimuths_cross_the_seam() -> None:
    """A target behind the sensor, about azimuth 180 degrees."""
    scan, _ = simulated(5.0, seed=2)
    behind = RingReturns.of([scan.select(np.arange(len(scan)), scan.points * [-1.0, -1.0, 1.0])])
    np.testing.assert_allclose(behind.azimuth, RingReturns.of([scan]).azimuth, atol=1e-12)
    assert np.ptp(behind.azimuth) < 1.0
