"""Noise: levels, edge shift, quantisation, dropout, bias."""

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target
from optshape_graph.simulation import NoiseModel, pose_from_rpy, simulate_target

TARGET, SENSOR = load_target("paper"), load_sensor("vlp32c")
POSE = pose_from_rpy([6.0, 0.0, 0.0])


def test_levels_are_those_of_the_released_settings():
    level = NoiseModel.level(3)
    assert (level.range_noise, np.degrees(level.azimuth_noise), np.degrees(level.elevation_noise)) == pytest.approx(
        (0.03, 0.3, 0.3)
    )
    assert NoiseModel.level(3, range_only=True) == NoiseModel(range_noise=0.03)
    assert NoiseModel.level(0) == NoiseModel()
    with pytest.raises(InputError, match="5 is not one of 0, 1, 2, 3, 4"):
        NoiseModel.level(5)


@pytest.mark.parametrize("fraction", [0.02, 0.2, 0.5, 0.8, 0.98])
def test_edge_shift_covers_the_stated_fraction_of_a_disc(fraction):
    """Against a fine grid of points in the unit disc: 1e6 cells give the area to about 1e-3."""
    x = NoiseModel(hit_fraction=fraction).edge_shift
    u, v = np.meshgrid(np.linspace(-1, 1, 1001), np.linspace(-1, 1, 1001))
    disc = u**2 + v**2 <= 1
    assert (disc & (u >= x)).sum() / disc.sum() == pytest.approx(fraction, abs=2e-3)


def test_spherical_noise_has_the_stated_standard_deviations():
    noise = NoiseModel(range_noise=0.02, azimuth_noise=1e-3, elevation_noise=2e-3)
    truth = simulate_target(TARGET, SENSOR, POSE)
    samples = []
    for seed in range(20):
        points = simulate_target(TARGET, SENSOR, POSE, noise=noise, rng=seed).points
        samples.append(_spherical(points) - _spherical(truth.points))
    spread = np.concatenate(samples).std(axis=0)
    # some 20 x 1,200 samples: a standard deviation is known to half a percent; four of these
    assert spread == pytest.approx([0.02, 1e-3, 2e-3], rel=0.02)


def test_ring_bias_moves_whole_rings():
    truth = simulate_target(TARGET, SENSOR, POSE)
    biased = simulate_target(TARGET, SENSOR, POSE, noise=NoiseModel(ring_bias=0.02), rng=3)
    shift = np.linalg.norm(biased.points, axis=1) - np.linalg.norm(truth.points, axis=1)
    per_ring = [shift[truth.ring == ring] for ring in np.unique(truth.ring)]
    assert max(np.ptp(ring) for ring in per_ring) < 1e-12
    assert np.std([ring[0] for ring in per_ring]) > 5e-3


def test_brightness_bias_moves_a_surface_as_a_whole():
    """Anew in every scan: the standard deviation over 200 scans, within three of its own (15 %)."""
    truth = np.linalg.norm(simulate_target(TARGET, SENSOR, POSE).points, axis=1)
    noise, rng, shifts = NoiseModel(brightness_bias=0.02), np.random.default_rng(0), []
    for _ in range(200):
        shift = np.linalg.norm(simulate_target(TARGET, SENSOR, POSE, noise=noise, rng=rng).points, axis=1) - truth
        assert np.ptp(shift) < 1e-12
        shifts.append(shift[0])
    assert np.std(shifts) == pytest.approx(0.02, rel=0.15)


def test_given_biases_are_used():
    bias = np.linspace(-0.1, 0.1, SENSOR.n_rings)
    truth = simulate_target(TARGET, SENSOR, POSE)
    scan = simulate_target(TARGET, SENSOR, POSE, range_bias=bias)
    shift = np.linalg.norm(scan.points, axis=1) - np.linalg.norm(truth.points, axis=1)
    np.testing.assert_allclose(shift, bias[truth.ring], atol=1e-12)
    with pytest.raises(InputError, match="32 rings"):
        simulate_target(TARGET, SENSOR, POSE, range_bias=bias[:3])


def test_ranges_are_multiples_of_the_resolution():
    scan = simulate_target(TARGET, SENSOR, POSE, noise=NoiseModel(range_noise=0.01, range_resolution=0.004))
    steps = np.linalg.norm(scan.points, axis=1) / 0.004
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


def test_dropout_grows_with_incidence():
    noise = NoiseModel(dropout=0.04)
    kept = {}
    for yaw in (0.0, 60.0):
        pose = pose_from_rpy([4.0, 0.0, 0.0], np.radians([0.0, 0.0, yaw]))
        full = len(simulate_target(TARGET, SENSOR, pose))
        kept[yaw] = np.mean([len(simulate_target(TARGET, SENSOR, pose, noise=noise, rng=k)) for k in range(20)]) / full
    # 0.04 face-on; 0.04 ** cos(60 deg) = 0.2 at 60 deg. The incidence varies by some degrees over the target.
    assert 1 - kept[0.0] == pytest.approx(0.04, abs=0.01)
    assert 1 - kept[60.0] == pytest.approx(0.20, abs=0.03)


def test_phase_is_drawn_only_when_asked():
    step = SENSOR.azimuth_step
    azimuth = _spherical(simulate_target(TARGET, SENSOR, POSE).points)[:, 1] / step
    np.testing.assert_allclose(azimuth, np.round(azimuth), atol=1e-6)
    phases = []
    for seed in range(50):
        azimuth = _spherical(
            simulate_target(TARGET, SENSOR, POSE, noise=NoiseModel(random_phase=True), rng=seed).points
        )
        turns = azimuth[:, 1] / step % 1.0
        assert np.ptp(np.exp(2j * np.pi * turns)) == pytest.approx(0, abs=1e-6)
        phases.append(turns[0])
    assert np.std(phases) == pytest.approx(1 / np.sqrt(12), abs=0.06)  # uniform, 50 draws


def test_same_seed_same_scan_and_generators_advance():
    noise = NoiseModel.of(SENSOR)
    a, b = (simulate_target(TARGET, SENSOR, POSE, noise=noise, rng=7) for _ in range(2))
    np.testing.assert_array_equal(a.points, b.points)
    rng = np.random.default_rng(7)
    a, b = (simulate_target(TARGET, SENSOR, POSE, noise=noise, rng=rng) for _ in range(2))
    assert a.points.shape != b.points.shape or np.abs(a.points - b.points).max() > 0


@pytest.mark.parametrize(
    "wrong",
    [{"range_noise": -1.0}, {"ring_bias": float("nan")}, {"dropout": 1.0}, {"hit_fraction": 0.0}, {"odd_ends": 1.0}],
)
def test_impossible_noise_is_refused(wrong):
    with pytest.raises(InputError, match="noise"):
        NoiseModel(**wrong)


def _spherical(points):
    r = np.linalg.norm(points, axis=1)
    return np.column_stack([r, np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / r)])


@pytest.mark.parametrize("distance", [2.0, 6.0, 20.0])
def test_edge_spread_moves_the_outline_within_the_beam(distance):
    """Upright edges, fine steps: ring ends lie up to half a beam beyond the edge, and never farther."""
    sensor, square = replace(SENSOR, azimuth_step=float(np.radians(0.01))), load_target("square")
    pose = pose_from_rpy([distance, 0.0, 0.0])
    exact = _ends(simulate_target(square, sensor, pose))
    outward = []
    for seed in range(20):
        ends = _ends(simulate_target(square, sensor, pose, noise=NoiseModel(edge_spread=0.5), rng=seed))
        outward += [(np.array(ends[ring]) - exact[ring]) * [-1, 1] for ring in exact]
    # Common part and own part of the decision: half a radius each. The edge is farther than the target's centre by
    # up to 14 % (at 2 m), where the beam is the narrower in angle.
    reach = 0.5 * (sensor.beam_divergence + sensor.beam_aperture / distance)
    assert 0.8 * reach < np.max(outward) <= reach + sensor.azimuth_step
    assert -reach <= np.min(outward) < 0.1 * reach


@pytest.mark.parametrize("roll", [0.0, 0.5])
def test_blooming_moves_ring_ends_along_the_ring(roll):
    """By as much on either side, whatever the slope of the edge; a standard deviation over 100 scans, within 25 %."""
    sensor, square = replace(SENSOR, azimuth_step=float(np.radians(0.01))), load_target("square")
    pose = pose_from_rpy([6.0, 0.0, 0.0], [roll, 0.0, 0.0])
    exact, noise, moved = _ends(simulate_target(square, sensor, pose)), NoiseModel(blooming=3e-3), []
    middle = sorted(exact)[len(exact) // 2]  # away from vertices
    for seed in range(100):
        right, left = np.array(_ends(simulate_target(square, sensor, pose, noise=noise, rng=seed))[middle])
        outward = (exact[middle][0] - right, left - exact[middle][1])
        assert outward[0] == pytest.approx(outward[1], abs=2.1 * sensor.azimuth_step)
        moved.append(outward[0])
    assert np.std(moved) == pytest.approx(3e-3, rel=0.25)


def _ends(scan):
    azimuth = _spherical(scan.points)[:, 1]
    return {
        ring: (azimuth[scan.ring == ring].min(), azimuth[scan.ring == ring].max())
        for ring in np.unique(scan.ring)[2:-2]
    }


@pytest.mark.parametrize(
    ("own", "common", "trend", "draw"),
    [
        ("range_bias_sd", "common_range_sd", "range_trend_sd", lambda noise, rng: noise.draw_range_bias(16, rng)),
        (
            "elevation_sd",
            "common_elevation_sd",
            "elevation_trend_sd",
            lambda noise, rng: noise.draw_angle_errors(16, rng).elevation,
        ),
        (
            "azimuth_sd",
            "common_azimuth_sd",
            "azimuth_trend_sd",
            lambda noise, rng: noise.draw_angle_errors(16, rng).azimuth,
        ),
    ],
)
def test_errors_of_a_calibrated_sensor_are_as_its_file_says(own, common, trend, draw):
    """Covariance of 4000 draws, to a tenth of the variances: each ring's own, what all share, and the trend."""
    sensor = load_sensor("vlp16")
    sds = np.linspace(1e-3, 2e-3, 16)
    sensor = replace(sensor, **{own: sds, common: 1e-3, trend: 1e-2})
    noise, rng = NoiseModel.of(sensor), np.random.default_rng(0)
    found = np.cov(np.array([draw(noise, rng) for _ in range(4000)]).T)
    said = np.diag(sds**2) + 1e-3**2 + 1e-2**2 * np.outer(sensor.trend, sensor.trend)
    np.testing.assert_allclose(found, said, atol=0.1 * said.max())
