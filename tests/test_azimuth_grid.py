"""Noisy angles: elevations put right, azimuths on the firing grid, what is no grid, and no bias in what is left."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import kstest

from optshape_graph import Scan, SensorModel
from optshape_graph.azimuth_grid import at_firing_times, level_rings, place_on_firings
from optshape_graph.edges import EdgePoints, extract_edge_points
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.ring_returns import RingReturns
from optshape_graph.simulation import IDEAL, NoiseModel, pose_from_rpy, simulate_target
from tests.pose.clouds import simulated

SENSOR = load_sensor("vlp32c")
STEP = float(SENSOR.azimuth_step or 0.0)


def cylinder(*azimuths: np.ndarray, distance: float = 8.0) -> Scan:
    """Returns at some azimuths (rad) of rings 10, 11, ... on a cylinder about the sensor."""
    ring = np.repeat(10 + np.arange(len(azimuths)), [len(a) for a in azimuths])
    a, elevation = np.concatenate(azimuths), SENSOR.elevations[ring]
    points = distance * np.column_stack([np.cos(a), np.sin(a), np.tan(elevation)])
    return Scan(points, ring, sensor=SENSOR)


def placed(scan: Scan, noise: float) -> EdgePoints:
    return place_on_firings(extract_edge_points(scan), RingReturns.of([scan]), noise)


def test_exact_azimuths_stay() -> None:
    scan = cylinder(STEP * np.arange(9), STEP * np.arange(4))
    edges = extract_edge_points(scan)
    assert place_on_firings(edges, RingReturns.of([scan]), 0.0) is edges


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


def sensor_without_beam() -> SensorModel:
    return replace(load_sensor("vlp32c"), range_noise=0.01, ring_bias=0.0, beam_divergence=0.0, beam_aperture=0.0,
                   elevation_error=0.0, azimuth_error=0.0)  # fmt: skip


def test_exact_angles_are_left_alone() -> None:
    returns = RingReturns.of([simulated(8.0, seed=1)[0]])
    leveled, noise = level_rings(returns)
    assert leveled is returns
    assert noise == 0.0


def test_noise_of_one_scan_does_not_move_another() -> None:
    noise = NoiseModel(azimuth_noise=np.radians(0.1), elevation_noise=np.radians(0.1))
    exact, noisy = simulated(8.0, seed=1)[0], simulated(6.0, seed=2, noise=noise)[0]
    both, found = level_rings(RingReturns.of([exact, noisy]))
    alone, of_noisy = level_rings(RingReturns.of([noisy]))
    assert found == pytest.approx([0.0, of_noisy[0]])
    np.testing.assert_array_equal(both.of_scan(0).points, RingReturns.of([exact]).points)
    np.testing.assert_allclose(both.of_scan(1).points, alone.points, atol=1e-12)


@pytest.mark.parametrize("noise_deg", [0.1, 0.3])
def test_noise_is_found_and_elevations_are_put_right(noise_deg: float) -> None:
    noise = NoiseModel(range_noise=0.01, azimuth_noise=np.radians(noise_deg), elevation_noise=np.radians(noise_deg))
    scan, _ = simulated(6.0, seed=2, sensor=sensor_without_beam(), noise=noise)
    assert scan.sensor is not None
    returns, (found,) = level_rings(RingReturns.of([scan]))
    (leveled,), scan = returns.sorted_scans(), scan.select(returns.row)
    assert scan.ring is not None
    # Several hundred returns: the standard deviation is known to a few per cent.
    assert found == pytest.approx(np.radians(noise_deg), rel=0.1)
    elevation = np.arcsin(leveled.points[:, 2] / np.linalg.norm(leveled.points, axis=1))
    np.testing.assert_allclose(elevation, scan.sensor.elevations[scan.ring], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(leveled.points, axis=1), np.linalg.norm(scan.points, axis=1), rtol=1e-12)


def test_no_bias_of_a_tilted_plane() -> None:
    """Azimuth errors move a return along the plane and off it; the normalised tilt errors' mean stays 0 (sd 0.16)."""
    target, level = load_target("paper"), NoiseModel.level(3).jittered()
    sensor = replace(sensor_without_beam(), range_noise=level.range_noise)
    normalised = []
    for seed in range(40):
        scan, T = simulated(8.0, (20, 30, 30), seed, sensor=sensor, noise=level)
        estimate = estimate_pose(scan, target)
        xi = gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(estimate.T_lidar_target) @ T))
        normalised.append(xi / np.sqrt(np.diag(estimate.covariance)))
    assert np.abs(np.mean(normalised, axis=0)[1:3]).max() < 4 * 0.16


@pytest.mark.parametrize("applied", [False, True])
def test_firing_times_are_applied_once(applied: bool) -> None:
    """Rings fired one after the other while the sensor turns clockwise: back to where they were fired, to 1e-9 m."""
    plain = load_sensor("vlp16")
    assert plain.azimuth_step is not None
    phases = np.arange(16) / 16
    fired = replace(plain, azimuth_offsets=-phases * plain.azimuth_step)  # where the simulator's rays go
    T = pose_from_rpy([5.0, 0.1, 0.0], [0.2, 0.1, -0.1])
    truth = simulate_target(load_target("paper"), fired, T, noise=IDEAL)
    assert truth.ring is not None
    sensor = replace(plain, firing_phases=phases)
    turn = np.exp(0.0 if applied else 1j * phases[truth.ring] * plain.azimuth_step)
    flat = (truth.points[:, 0] + 1j * truth.points[:, 1]) * turn
    recorded = replace(truth, points=np.column_stack([flat.real, flat.imag, truth.points[:, 2]]), sensor=sensor)
    np.testing.assert_allclose(
        at_firing_times(RingReturns.of([recorded])).points, RingReturns.of([truth]).points, atol=1e-9
    )
    unknown = RingReturns.of([replace(recorded, sensor=plain)])
    assert at_firing_times(unknown) is unknown
