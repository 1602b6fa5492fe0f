"""Noise, ring biases and shapes, out of distances from a plane that were drawn with known ones."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, f

from optshape_graph.gaussian import chi_square_tail, f_tail
from optshape_graph.groups import Groups, Layout
from optshape_graph.io import load_target
from optshape_graph.pose import PoseOptions
from optshape_graph.pose.ends.fit import SEEN
from optshape_graph.pose.evidence import OUTLYING, measure
from tests.pose.clouds import simulated

PAPER = load_target("paper@0.7")
RADIUS = PAPER.gyration


def residuals(seed: int, noise: float = 1.0, bias: float = 1.0, distance: float = 5.0, turn: float = 0.0):
    """Of a scan at 5 m: about 30 rings, 900 returns; noise and bias in units of the sensor file's."""
    from optshape_graph.io import load_sensor
    from optshape_graph.simulation import NoiseModel

    sensor = load_sensor("vlp32c")
    worse = replace(sensor, range_noise=noise * sensor.range_noise, ring_bias=bias * sensor.ring_bias)
    scan, _ = simulated(distance, (0.0, turn, 0.0), seed, PAPER, sensor, NoiseModel.of(worse))
    (evidence,) = measure([scan], [PAPER], PoseOptions())
    return evidence.residuals, evidence.scan


def test_tails_are_those_of_scipy() -> None:
    """To a factor of three down to a millionth, on the safe side; and nothing without freedom."""
    for k, freedom, ratio in [(1, 40, 20.0), (3, 200, 12.0), (3, 900, 4.0), (2, 15, 30.0), (6, 100, 1.0)]:
        assert 0.95 < f_tail(ratio, k, freedom) / f.sf(ratio, k, freedom) < 3.0
    for freedom, square in [(3, 20.0), (30, 60.0), (60, 150.0)]:
        assert 0.9 < chi_square_tail(square, freedom) / chi2.sf(square, freedom) < 3.0
    assert f_tail(1e9, 3, 0) == chi_square_tail(1e9, 0) == 1.0


@pytest.mark.parametrize(("noise", "bias"), [(1.0, 1.0), (5.0, 1.0), (1.0, 5.0), (0.2, 0.2)])
def test_noise_and_bias_are_seen(noise: float, bias: float) -> None:
    """Medians of 20 scans to a tenth and a fifth; never less than the file's."""
    seen = [residuals(seed, noise, bias)[0] for seed in range(20)]
    assert np.median([(r.noise / r.file_noise)[0] for r in seen]) == pytest.approx(max(noise, 1.0), rel=0.1)
    assert np.median([(r.bias / r.file_bias)[0] for r in seen]) == pytest.approx(max(bias, 1.0), rel=0.2)


@pytest.mark.slow
def test_flat_boards_are_flat() -> None:
    """SEEN is a probability: of 200 flat boards 2 % seem to have a shape; 4 have a standard deviation of 2."""
    assert sum(residuals(seed)[0].surfaces(SEEN)[0].size > 0 for seed in range(200)) <= 12


@pytest.mark.parametrize("seed", range(5))
def test_a_bend_is_seen_at_its_size(seed: int) -> None:
    """A cylinder about z, 5 cm deep at one radius of gyration: rms to a fifth."""
    flat, _ = residuals(seed)
    depth = 0.05 * flat.yz[:, 0] ** 2
    bent = replace(flat, e=flat.e + depth)
    plane = flat.terms[:, :3]
    shape = depth - plane @ np.linalg.lstsq(plane, depth, rcond=None)[0]
    (found,) = bent.surfaces(SEEN)
    assert found.probability < 1e-12
    assert found.size == pytest.approx(np.sqrt(np.mean(shape**2)), rel=0.2)


def test_a_fold_is_told_from_a_bend() -> None:
    flat, _ = residuals(3)
    folded = replace(flat, e=flat.e + 0.08 * np.abs(flat.yz[:, 0] + 0.2))
    assert folded.surfaces(SEEN)[0].shape == "fold"


@settings(max_examples=10)
@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-1.0, 1.0))
def test_a_tilted_plane_is_no_shape(y: float, z: float, offset: float) -> None:
    flat, _ = residuals(1)
    tilted = replace(flat, e=flat.e + flat.terms[:, :3] @ [offset, y, z])
    assert tilted.surfaces(SEEN)[0].probability == pytest.approx(flat.surfaces(SEEN)[0].probability, rel=1e-3)


def test_mixed_pixels_are_left_out() -> None:
    _, scan = residuals(2)
    rows = np.random.default_rng(0).choice(len(scan), 20, replace=False)
    points = scan.points.copy()
    points[rows] *= 1.03  # 15 cm at 5 m
    (evidence,) = measure([replace(scan, points=points)], [PAPER], PoseOptions())
    mixed, ordered = evidence.residuals, evidence.scan
    assert not mixed.usual[(ordered.points[:, None] == points[rows]).all(axis=2).any(axis=1)].any()
    assert mixed.usual.sum() >= len(scan) - 22
    assert np.abs(mixed.rest[mixed.usual]).max() <= OUTLYING * mixed.noise


def test_a_rim_that_stands_out() -> None:
    """By 3 cm, to 5 mm; and none where there is none."""
    flat, scan = residuals(4)
    rim = np.linalg.norm(flat.yz, axis=1) > 1.2
    inner = np.ones(len(scan), dtype=bool)
    step, chance = replace(flat, e=flat.e - 0.03 * rim).rim_step(rim, inner)
    assert step == pytest.approx(-0.03, abs=5e-3)
    assert chance < 1e-8
    assert flat.rim_step(rim, inner)[1] > 1e-4


def test_two_revolutions_apart() -> None:
    """Neighbours alternate, and the second half of the recording lies 2 cm behind."""
    flat, scan = residuals(5, noise=0.3)
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    row = np.arange(len(scan))
    assert flat.sheets(azimuth, row)[0].apart == 0.0
    again = np.tile([0, 1], len(scan))  # each return twice, the one right after the other in its ring
    twice = replace(
        flat,
        e=np.repeat(flat.e, 2) + 0.02 * again, yz=np.repeat(flat.yz, 2, axis=0),
        layout=Layout(Groups(2 * flat.rings.counts), flat.layout.rings_of_scan),
        rest=np.repeat(flat.rest, 2) + 0.02 * again - 0.01, usual=np.repeat(flat.usual, 2),
    )  # fmt: skip
    (found,) = twice.sheets(np.repeat(azimuth, 2) - 1e-4 * again, np.repeat(row, 2) + len(scan) * again)
    assert found.correlation < -0.25
    assert found.apart == pytest.approx(0.01, rel=0.2)
    assert found.probability < 1e-8
