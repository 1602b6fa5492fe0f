"""Noisy azimuths on the firing grid: where they are, gaps, and what is no grid."""

import numpy as np
import pytest
from scipy.stats import kstest

from optshape_graph import Scan
from optshape_graph.edges import EdgePoints, extract_edge_points
from optshape_graph.io import load_sensor
from optshape_graph.pose.firing import place_on_firings

SENSOR = load_sensor("vlp32c")
STEP = float(SENSOR.azimuth_step or 0.0)


def cylinder(*azimuths: np.ndarray, distance: float = 8.0) -> Scan:
    """Returns at some azimuths (rad) of rings 10, 11, ... on a cylinder about the sensor."""
    ring = np.repeat(10 + np.arange(len(azimuths)), [len(a) for a in azimuths])
    a, elevation = np.concatenate(azimuths), SENSOR.elevations[ring]
    points = distance * np.column_stack([np.cos(a), np.sin(a), np.tan(elevation)])
    return Scan(points, ring, sensor=SENSOR)


def placed(scan: Scan, noise: float) -> EdgePoints:
    return place_on_firings(extract_edge_points(scan), scan, noise)


def test_exact_azimuths_stay() -> None:
    scan = cylinder(STEP * np.arange(9), STEP * np.arange(4))
    edges = extract_edge_points(scan)
    assert place_on_firings(edges, scan, 0.0) is edges


@pytest.mark.parametrize("jitter", [0.1, 0.25, 0.75])
def test_width_is_that_of_the_firings_and_both_ends_share_a_shift(jitter: float) -> None:
    rng = np.random.default_rng(0)
    counts = rng.integers(1, 30, 400)
    errors, claimed = [], []
    for block in counts.reshape(-1, 20):
        exact = [STEP * (np.arange(n) + 0.3) for n in block]
        scan = cylinder(*(a + rng.normal(0, jitter * STEP, len(a)) for a in exact))
        edges = placed(scan, jitter * STEP)
        np.testing.assert_allclose(edges.azimuth[::2] - edges.azimuth[1::2], STEP * (block - 1), atol=1e-9)
        np.testing.assert_allclose(edges.shift, np.repeat(jitter * STEP / np.sqrt(block), 2))
        np.testing.assert_allclose(edges.width, STEP)
        # The points are where their azimuths say, at the ranges and heights that they had.
        seen = np.arctan2(edges.points[:, 1], edges.points[:, 0]) - edges.reference_azimuth
        np.testing.assert_allclose(seen, edges.azimuth, atol=1e-9)
        left = edges.azimuth[::2] + edges.reference_azimuth
        errors.append(left - [a[-1] for a in exact])
        claimed.append(edges.shift[::2])
    assert kstest(np.concatenate(errors) / np.concatenate(claimed), "norm").pvalue > 1e-3


def test_a_firing_left_out_is_seen_where_the_noise_is_small() -> None:
    rng = np.random.default_rng(1)
    slots = np.array([0, 1, 2, 3, 5, 6, 7, 10, 11])
    scan = cylinder(STEP * slots + rng.normal(0, 0.1 * STEP, 9), STEP * np.arange(12) + rng.normal(0, 0.1 * STEP, 12))
    edges = placed(scan, 0.1 * STEP)
    assert edges.azimuth[0] - edges.azimuth[1] == pytest.approx(11 * STEP)
    assert edges.azimuth[2] - edges.azimuth[3] == pytest.approx(11 * STEP)


@pytest.mark.parametrize("jitter", [0.25, 0.75])
def test_none_is_made_up(jitter: float) -> None:
    """One ring in a hundred at most looks as if a firing had been left out."""
    rng = np.random.default_rng(2)
    wrong = 0
    for _ in range(30):
        scan = cylinder(*(STEP * np.arange(12) + rng.normal(0, jitter * STEP, 12) for _ in range(10)))
        edges = placed(scan, jitter * STEP)
        assert (edges.shift > 0).all()
        wrong += int((np.abs(edges.azimuth[::2] - edges.azimuth[1::2] - 11 * STEP) > 1e-6).sum())
    assert wrong <= 3


@pytest.mark.parametrize("what", ["two revolutions", "irregular"])
def test_what_is_no_grid_keeps_its_extremes(what: str) -> None:
    rng = np.random.default_rng(3)
    noise = 0.1 * STEP
    grid = STEP * np.arange(24)
    if what == "two revolutions":
        exact = [np.concatenate([grid, grid + 0.4 * STEP])] * 4
    else:
        exact = [grid + rng.uniform(-0.45, 0.45, 24) * STEP for _ in range(4)]
    scan = cylinder(*(a + rng.normal(0, noise, len(a)) for a in exact))
    before, after = extract_edge_points(scan), placed(scan, noise)
    np.testing.assert_array_equal(after.points, before.points)
    assert (after.shift == 0).all()
    assert (after.scatter > 0).all()
    # An extreme of noisy azimuths is as often beyond the last firing as not.
    assert (after.lower < 0).all()
