"""The ray caster against closed-form geometry."""

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph.io import load_sensor, load_target
from tests.casting.caster import Receiver, Wall, cast, disc, firing_phases

FACE_ON = np.array([[1.0, 0, 0, 10], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
SENSOR = load_sensor("vlp16")


def thin(name="vlp16"):
    return replace(load_sensor(name), beam_divergence=0.0, beam_aperture=0.0)


def test_disc_fills_the_circle():
    """Second moment of a uniform disc: 1/4 along each axis, within 5 % for 37 points; no point outside."""
    points = disc()
    assert np.linalg.norm(points, axis=1).max() < 1
    assert np.allclose((points**2).mean(axis=0), 0.25, rtol=0.12)


@pytest.mark.parametrize("seed", range(3))
def test_thin_beams_return_where_the_square_is(seed):
    """Every ray through the square returns, no other does, each on the plane x = 10 m."""
    scan, own = cast(load_target("square"), thin(), FACE_ON, Receiver(threshold_noise=0.0), np.random.default_rng(seed))
    assert own.all()
    assert np.allclose(scan.points[:, 0], 10.0, atol=1e-12)
    assert np.abs(scan.points[:, 1:]).max() <= 0.5 + 1e-12
    for ring in np.unique(scan.ring):  # the chord of a ring is a metre: 28.6 steps of 0.2 deg at 10 m
        width = np.ptp(np.arctan2(*scan.points[scan.ring == ring, 1::-1].T))
        full, step = 2 * np.arctan(0.05), np.radians(0.2)
        assert full - 2 * step < width <= full
    rings = np.flatnonzero(np.abs(10 * np.tan(SENSOR.elevations)) <= 0.5)
    assert np.isin(np.unique(scan.ring), rings).all()
    assert len(np.unique(scan.ring)) == len(rings)


@pytest.mark.parametrize(("threshold", "beams"), [(0.5, 0.0), (0.195, 0.25), (0.805, -0.25)])
def test_a_wide_beam_reaches_past_the_edge_by_the_share_that_is_asked(threshold, beams):
    """A half plane whose border is 0.25 beam widths from the axis holds 19.5 % of the disc, or 80.5 %."""
    sensor = replace(SENSOR, azimuth_step=np.radians(0.005))
    scan, _ = cast(
        load_target("square"), sensor, FACE_ON, Receiver(threshold, threshold_noise=0.0), np.random.default_rng(0)
    )
    width = sensor.beam_aperture + sensor.beam_divergence * 10
    middle = scan.points[np.abs(scan.points[:, 2]) < 0.3]
    assert np.ptp(middle[:, 1]) / 2 == pytest.approx(0.5 + beams * width, abs=0.08 * width)


def test_the_strongest_wins_against_a_wall():
    """A wall twice as bright takes the beams that are less than two thirds on the target (close behind it)."""
    sensor = replace(SENSOR, azimuth_step=np.radians(0.005))
    square, rng = load_target("square"), np.random.default_rng(0)
    alone, _ = cast(square, sensor, FACE_ON, Receiver(0.3, threshold_noise=0.0), rng)
    scan, own = cast(square, sensor, FACE_ON, Receiver(0.3, threshold_noise=0.0), rng, Wall(0.2, 2.0))
    first, own_first = cast(square, sensor, FACE_ON, Receiver(0.3, 0.0, first=True), rng, Wall(0.2, 2.0))
    spans = [np.ptp(s.points[k][np.abs(s.points[k][:, 2]) < 0.3, 1])
             for s, k in ((alone, slice(None)), (scan, own), (first, own_first))]  # fmt: skip
    assert spans[1] < spans[0] - 0.01
    assert spans[2] == pytest.approx(spans[0], abs=2e-3)
    assert np.allclose(scan.points[~own, 0], 10.2, atol=0.01)


def test_noise_is_what_the_receiver_says():
    """Standard deviation of ranges over a dense ring, 10 % of 5 mm; biases part the rings."""
    sensor = replace(SENSOR, azimuth_step=np.radians(0.005))
    scan, _ = cast(
        load_target("square"), sensor, FACE_ON, Receiver(range_noise=0.005, ring_bias=0.02), np.random.default_rng(2)
    )
    inner = np.abs(scan.points[:, 1]) < 0.4
    off = 10.0 * np.linalg.norm(scan.points[inner] / scan.points[inner, :1], axis=1) - np.linalg.norm(
        scan.points[inner], axis=1
    )
    ring = scan.ring[inner]
    means = np.array([off[ring == r].mean() for r in np.unique(ring)])
    within = np.concatenate([off[ring == r] - off[ring == r].mean() for r in np.unique(ring)])
    assert within.std() == pytest.approx(0.005, rel=0.1)
    assert means.std() > 0.005


def test_a_bright_target_blooms():
    """A tenth of the energy in a halo, and a threshold of a hundredth: returns lie up to two beam widths outside."""
    sensor = replace(SENSOR, azimuth_step=np.radians(0.005), beam_aperture=0.0)
    square, rng = load_target("square"), np.random.default_rng(0)
    reach = []
    for glow in (0.0, 0.1):
        scan, _ = cast(square, sensor, FACE_ON, Receiver(0.01, threshold_noise=0.0, glow=glow), rng)
        middle = np.abs(scan.points[:, 2]) < 0.3
        reach.append((np.ptp(scan.points[middle, 1]) / 2 - 0.5) / (10 * sensor.beam_divergence))
    assert 0.3 < reach[0] < 0.5
    assert 1.0 < reach[1] < 2.0


def test_brightness_moves_the_target_alone():
    square, wall = load_target("square"), Wall(2.0)
    (dark, own), (plain, same) = (
        cast(square, SENSOR, FACE_ON, Receiver(brightness=b), np.random.default_rng(0), wall) for b in (0.02, 0.0)
    )
    assert np.array_equal(own, same)
    off = np.linalg.norm(dark.points, axis=1) - np.linalg.norm(plain.points, axis=1)
    assert np.allclose(off, 0.02 * own, atol=1e-12)


def test_firing_orders():
    """Every slot of the VLP-16 once; pairs on the VLP-32C; four columns of an OS1."""
    assert np.allclose(np.sort(firing_phases(load_sensor("vlp16"))), np.arange(16) / 24)
    assert np.array_equal(np.unique(firing_phases(load_sensor("vlp32c")), return_counts=True)[1], [2] * 16)
    assert len(np.unique(firing_phases(load_sensor("os1-64")).round(9))) == 4
