import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from optshape_graph import InputError, UnobservableError
from optshape_graph.io.mocap import MocapRecording
from optshape_graph.io.recordings.clocks import (
    angular_speed,
    estimate_clock_offset,
    marker_rotations,
    masked_correlation,
)

LAYOUT = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.3, 0], [0.1, 0.1, 0.25]])


def motion(seed: int, seconds: float = 40.0, amplitude: float = 0.6):
    """A body turned about irregularly by hand: R(t)."""
    rng = np.random.default_rng(seed)
    knots = np.arange(0, seconds + 1, 0.7)
    spline = CubicSpline(knots, rng.normal(0, amplitude, (len(knots), 3)))
    return lambda t: Rotation.from_rotvec(spline(t))


def mocap_of(times, rotations, noise, rng, rate=200.0):
    positions = np.einsum("fij,mj->fmi", rotations.as_matrix(), LAYOUT) + rng.normal(0, noise, (len(times), 4, 3))
    return MocapRecording(times, ("a", "b", "c", "d"), positions, rate)


@pytest.mark.parametrize("seed", range(4))
def test_offset_of_noisy_odometry_and_markers_is_found_to_milliseconds(seed):
    rng = np.random.default_rng(seed)
    R, true = motion(seed), 1.7e9 + 12.3456
    ours = np.arange(2.0, 30.0, 0.1)
    mounted = Rotation.random(rng=seed)
    odometry = R(ours) * mounted * Rotation.from_rotvec(rng.normal(0, 2e-3, (len(ours), 3)))
    theirs = np.arange(0.0, 36.0, 1 / 200)
    mocap = mocap_of(theirs, R(theirs + 1.5), 0.5e-3, rng)  # its clock starts at 1.5 s of the motion
    found = estimate_clock_offset(ours + true - 12.3456, odometry, *marker_rotations(mocap))
    # mocap time t is motion time t + 1.5, which the other clock calls t + 1.5 + 1.7e9
    error = found.seconds - (1.5 + true - 12.3456)
    assert abs(error) < 4e-3
    assert abs(error) < 5 * found.standard_deviation + 1e-3  # 1 ms: float64 at 1.7e9 s, and interpolation over 0.1 s
    assert found.correlation > 0.95


def test_gaps_do_not_move_the_offset():
    rng = np.random.default_rng(5)
    R, t = motion(5), np.arange(0, 40, 1 / 200)
    mocap = mocap_of(t, R(t), 0.5e-3, rng)
    positions = mocap.positions.copy()
    positions[1000:1400, :] = np.nan
    positions[3000:3600, 2:] = np.nan
    gappy = MocapRecording(t, mocap.markers, positions, 200.0)
    ours = np.arange(5, 35, 0.05)
    found = estimate_clock_offset(ours - 3.0, R(ours), *marker_rotations(gappy))
    assert found.seconds == pytest.approx(-3.0, abs=4e-3)


def test_a_sensor_that_stands_still_has_no_observable_offset():
    t = np.arange(0, 20, 0.1)
    still = Rotation.from_rotvec(np.zeros((len(t), 3)))
    with pytest.raises(UnobservableError, match="hardly turned"):
        estimate_clock_offset(t, still, t, motion(1)(t))


def test_a_periodic_motion_has_no_unique_offset():
    t = np.arange(0, 60, 0.05)
    swing = Rotation.from_rotvec(np.outer(0.5 * np.sin(2 * np.pi * t / 4), [0, 0, 1]))
    with pytest.raises(UnobservableError, match="repeats itself"):
        estimate_clock_offset(t, swing, t, swing)


@pytest.mark.parametrize("seed", range(5))
def test_unrelated_motions_have_no_offset(seed):
    t = np.arange(0, 30, 0.05)
    with pytest.raises(UnobservableError):
        estimate_clock_offset(t, motion(seed)(t), t, motion(seed + 100)(t))


def test_angular_speed_of_constant_turning_is_that_speed():
    t = np.sort(np.random.default_rng(0).uniform(0, 10, 500))
    speed, seen = angular_speed(t, Rotation.from_rotvec(np.outer(0.7 * t, [0, 1, 0])))
    assert np.abs(speed[seen] - 0.7).max() < 1e-9  # Slerp is exact for a constant rate


def test_masked_correlation_is_the_pearson_correlation_of_what_both_saw():
    rng = np.random.default_rng(1)
    a, b = rng.normal(3, 1, 60), rng.normal(3, 1, 45)
    seen_a, seen_b = rng.random(60) < 0.8, rng.random(45) < 0.8
    lags, correlation, overlap = masked_correlation(a, seen_a, b, seen_b)
    for lag in (-20, 0, 15, 30):
        i = np.arange(max(0, lag), min(60, 45 + lag))
        both = seen_a[i] & seen_b[i - lag]
        k = int(np.flatnonzero(lags == lag)[0])
        assert overlap[k] == both.sum()
        assert correlation[k] == pytest.approx(np.corrcoef(a[i][both], b[i - lag][both])[0, 1], abs=1e-9)


def test_markers_that_are_not_on_one_body_are_refused():
    t = np.arange(0, 5, 0.01)
    positions = np.random.default_rng(2).normal(0, 0.3, (len(t), 4, 3))
    with pytest.raises(InputError, match="against each other"):
        marker_rotations(MocapRecording(t, ("a", "b", "c", "d"), positions, 100.0))


def test_markers_in_a_line_are_refused():
    t = np.arange(0, 5, 0.01)
    line = np.outer([0, 0.1, 0.2], [1, 0, 0])
    positions = np.einsum("fij,mj->fmi", motion(1)(t).as_matrix(), line)
    with pytest.raises(InputError, match="in a line"):
        marker_rotations(MocapRecording(t, ("a", "b", "c"), positions, 100.0))
