"""A sensor's calibration: what is hidden is found as well as it is said to be, and judged by placements left out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import H

from optshape_graph import EstimationError, InputError, SensorCalibration
from optshape_graph.calibration.sensor import Distance, Sighting, calibrate_placements, gather
from optshape_graph.calibration.sensor.calibrate import _turns as turns_of
from optshape_graph.calibration.sensor.graph import solve
from optshape_graph.calibration.sensor.known import distance_factor, known_beside
from optshape_graph.calibration.sensor.noise import sampling
from optshape_graph.calibration.sensor.placements import placed as of_runs
from optshape_graph.calibration.sensor.placements import runs_of
from optshape_graph.calibration.sensor.rest import at_rest
from optshape_graph.calibration.sensor.seen import Seen
from optshape_graph.io import load_sensor, load_target, save_sensor
from optshape_graph.pose import PoseEstimate, estimate_pose
from optshape_graph.scan import put_right
from optshape_graph.se3 import apply, exp, inverse
from optshape_graph.simulation import pose_from_rpy
from tests.calibration.sensor.units import Unit, placed, sightings
from tests.io.schema_support import complaint


@pytest.fixture(scope="module")
def unit() -> Unit:
    return Unit.drawn("vlp16", np.random.default_rng(1))


@pytest.fixture(scope="module")
def seen(unit: Unit) -> list[Sighting]:
    return sightings(unit, 10, 2.5, 6.0, np.random.default_rng(2))


@pytest.fixture(scope="module")
def result(unit: Unit, seen: list[Sighting]) -> SensorCalibration:
    return calibrate_placements(gather(seen), unit.sensor)


def test_what_is_hidden_is_found(unit: Unit, result: SensorCalibration) -> None:
    """Within 4 of the standard deviations that are stated, which are a third to two thirds of the data sheet's."""
    sensor = result.sensor
    assert sensor.range_bias is not None
    assert sensor.azimuth_offsets is not None
    given, elevations = unit.sensor, unit.sensor.elevations + unit.angles.elevation
    for off, sd, common, most in (
        (
            sensor.range_bias - unit.range_bias,
            sensor.range_bias_sds,
            sensor.common_range_sd,
            0.5 * given.range_bias_sds,
        ),
        (sensor.elevations - elevations, sensor.elevation_sds, sensor.common_elevation_sd, given.elevation_sds),
        (sensor.azimuth_offsets - unit.angles.azimuth, sensor.azimuth_sds, sensor.common_azimuth_sd, given.azimuth_sds),
    ):
        assert (np.abs(off) < 4 * np.hypot(sd, common)).all()
        assert (sd <= most).all()
    assert abs(sensor.edge_offset - unit.edge_offset) < 4 * sensor.edge_offset_sd
    assert sensor.range_noise == pytest.approx(unit.sensor.range_noise, rel=0.1)


def test_placements_left_out_judge(result: SensorCalibration) -> None:
    assert result.helps
    assert result.trusted
    assert all(one.gain is not None for one in result.placements)
    assert np.nanmean(result.after) < 0.6 * np.nanmean(result.before)


def test_what_free_boards_cannot_tell_is_named(result: SensorCalibration) -> None:
    told = {one.name: one.told for one in result.directions}
    assert not any(told[name] for name in ("mean range bias", "mean elevation", "mean azimuth"))
    assert any("mean range bias" in text for text in result.warnings)


def test_biases_that_rings_do_not_keep_are_not_written(unit: Unit) -> None:
    rng = np.random.default_rng(5)
    found = []
    for moment in range(6):
        angles = unit.noise.draw_angle_errors(16, rng)
        other = replace(unit, range_bias=0.01 * rng.normal(size=16), angles=angles)
        found += [replace(one, moment=moment) for one in sightings(other, 1, 3.0, 5.0, rng)]
    result = calibrate_placements(gather(found), unit.sensor)
    assert not result.helps or result.gain < 3 * len(result.placements)
    assert result.drift > 0.005 or not result.helps


def test_a_result_is_saved_and_fits_its_schema(result: SensorCalibration, tmp_path: Path) -> None:
    result.save(tmp_path / "a.json")
    assert SensorCalibration.load(tmp_path / "a.json") == result
    assert complaint(tmp_path / "a.json") is None
    assert repr(result).startswith("SensorCalibration('vlp16', ")
    assert len(result.rows()) == 16


def test_clouds_are_put_right_by_the_file(unit: Unit, result: SensorCalibration, tmp_path: Path) -> None:
    """Once: rings of a fresh board are then on its plane, to what is left."""
    save_sensor(tmp_path / "mine.yaml", result.sensor)
    assert complaint(tmp_path / "mine.yaml") is None
    sensor = load_sensor(tmp_path / "mine.yaml")
    rng = np.random.default_rng(9)
    fresh = sightings(unit, 3, 3.0, 5.0, rng)
    rms = []
    for file in (unit.sensor, sensor):
        off = []
        for one in fresh:
            scan = put_right(replace(one.returns, sensor=file))
            assert put_right(scan) is scan
            target, T = one.estimate.target, one.estimate.T_target_lidar
            off.append(Seen.of(scan, target, 0, T).ring_residuals(T, {})[1])
        rms.append(np.sqrt(np.mean(np.concatenate(off) ** 2)))
    assert rms[1] < 0.7 * rms[0]


def test_a_known_distance_tells_the_mean_range(unit: Unit) -> None:
    """Two boards on either side of the sensor, whose ranges are all too far by 3 cm."""
    rng = np.random.default_rng(3)
    far = replace(unit, range_bias=unit.range_bias - unit.range_bias.mean() + 0.03)
    poses = [placed(unit.sensor, 3.0, 4.0, rng) for _ in range(2)]
    found = []
    for moment in range(4):
        for name, T in zip(("paper", "square"), poses, strict=True):
            found.append(_seen_at(far, name, T, moment, rng))
    placements = gather(found)
    assert [len(one.sightings) for one in placements] == [4, 4]
    metres = float(np.linalg.norm(poses[0][:3, 3] - poses[1][:3, 3]))
    start = {p: one.sightings[0].estimate.T_target_lidar for p, one in enumerate(placements)}
    given = replace(unit.sensor, ring_bias=0.03)
    views = [
        Seen.of(replace(one.returns, sensor=given), placement.target, p, start[p])
        for p, placement in enumerate(placements)
        for one in placement.sightings
    ]
    joint = solve(views, start, known_beside(placements, [Distance.parsed("paper", "square", metres)]))
    apart = [apply(inverse(joint.T_target_lidar[p]), np.zeros((1, 3)))[0] for p in (0, 1)]
    assert np.linalg.norm(apart[0] - apart[1]) == pytest.approx(metres, abs=0.006)


def _seen_at(unit: Unit, name: str, T: np.ndarray, moment: int, rng: np.random.Generator) -> Sighting:
    returns = unit.scan(load_target(name), T, rng)
    return Sighting(moment, f"{moment}", estimate_pose(returns, load_target(name)), returns)


@pytest.mark.parametrize("seed", range(3))
def test_derivative_of_a_distance(seed: int) -> None:
    """Against differences, to 1e-6 of a standard deviation of 1 m."""
    rng = np.random.default_rng(seed)
    T, a, b = exp(rng.normal(size=(2, 6))), rng.normal(size=3), rng.normal(size=3)
    values = gtsam.Values()
    for k in range(2):
        values.insert(H(k), gtsam.Pose3(T[k]))
    factor = distance_factor(0, a, 1, b, 2.0, 1.0)
    A, _ = factor.linearize(values).jacobian()
    for column in range(12):
        step = np.zeros(6)
        step[column % 6] = 1e-6
        ends = []
        for sign in (1, -1):
            moved = gtsam.Values(values)
            moved.update(H(column // 6), gtsam.Pose3(T[column // 6] @ exp(sign * step)))
            ends.append(factor.unwhitenedError(moved)[0])
        assert A[0, column] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-6)


def test_boards_that_stand_still_are_one_placement(seen: list[Sighting]) -> None:
    still = [replace(seen[0], moment=k) for k in range(12)]
    placements = gather([*still, *(replace(one, moment=20) for one in seen[3:4])])
    assert [len(one.sightings) for one in placements] == [8, 1]
    assert of_runs(runs_of(still[:3]), fewest=4) == ()


@pytest.mark.parametrize("speed", [0.0, 0.008])
def test_boards_that_move_are_left_out_and_named(speed: float) -> None:
    """Eight millimetres from revolution to revolution; each pose is uncertain by five."""
    rng = np.random.default_rng(8)
    unit, found = Unit.drawn("vlp32c", rng), []
    for run in range(3):
        first = placed(unit.sensor, 3.0, 4.0, rng)
        for k in range(4):
            T = first.copy()
            T[1, 3] += speed * k
            found.append(_seen_at(unit, "paper", T, 10 * run + k, rng))
    kept, moved = at_rest(gather(found))
    assert len(kept) == (3 if speed == 0 else 0)
    assert len(moved) == 3 - len(kept)
    assert all("paper from" in text and "while it should stand still" in text for text in moved)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("paper/x", "square", 1.0), "the vertex as its number"),
        (("paper", "square", "long"), "expected positive numbers"),
        (("paper", "square", -1.0), "expected positive numbers"),
    ],
)
def test_what_is_no_distance(arguments: tuple[str, str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Distance.parsed(*arguments)


def test_distances_to_what_was_not_seen(seen: list[Sighting]) -> None:
    placements = gather(seen)
    for a, b, message in (("paper", "round", "was not seen"), ("paper/9", "square", "vertices 0 to 3")):
        with pytest.raises(InputError, match=message):
            known_beside(placements, [Distance.parsed(a, b, 2.0)])


def test_a_distance_holds_where_boards_stood_that_far_apart(unit: Unit) -> None:
    """Of three ways in which they stood, one fits; or none; or two that differ by more than their covariances."""
    rng = np.random.default_rng(21)
    seen = []
    for moment, apart in enumerate((0.0, 0.5, 0.1)):
        for name, T in (
            ("paper", pose_from_rpy([3.0 + apart, 0.0, 0.0], [0.4, 0.1, 0.1])),
            ("square", pose_from_rpy([-3.5, 0.0, 0.0], [0.5, 0.1, np.pi + 0.1])),
        ):
            seen.append(_seen_at(unit, name, T, moment, rng))
    placements = gather(seen)
    assert len(placements) == 6 - 2  # the square stays
    known = known_beside(placements, [Distance.parsed("paper", "square", 7.0)])
    assert known.factors.size() == 1
    with pytest.raises(InputError, match=r"measured 9 m apart; .* are 6\.\d+ m apart at best"):
        known_beside(placements, [Distance.parsed("paper", "square", 9.0)])
    with pytest.raises(InputError, match=r"more than one way in which they stood fits, .* name the scan: 6\.55@0"):
        known_beside(placements, [Distance.parsed("paper", "square", 6.55)])
    known = known_beside(placements, [Distance.parsed("paper", "square", "6.55@2")])
    assert list(known.factors.at(0).keys()) == [H(3), H(1)]


def test_what_is_left_out_in_turn(seen: list[Sighting]) -> None:
    """Moments of one session, or of several of which one has most; else sessions."""
    placements = gather(replace(seen[0], moment=k, place=k, estimate=_aside(seen[0], k)) for k in range(9))
    thirds = [{0, 3, 6}, {1, 4, 7}, {2, 5, 8}]
    assert turns_of(placements, ()) == turns_of(placements, [range(9)]) == thirds
    assert turns_of(placements, [range(7), range(7, 9)]) == thirds
    assert turns_of(placements, [range(6), range(6, 9)]) == [set(range(6)), {6, 7, 8}]
    assert turns_of(placements, [range(3), range(3, 5), range(5, 8), range(8, 9)]) == [{0, 1, 2, 8}, {3, 4}, {5, 6, 7}]


def _aside(one: Sighting, k: int) -> PoseEstimate:
    return replace(one.estimate, T_lidar_target=exp(np.array([0.3 * k, 0, 0, 0, 0, 0])) @ one.estimate.T_lidar_target)


@pytest.mark.parametrize("bent", [0.0, 0.02])
def test_noise_is_lowered_as_far_as_rings_are_straight(unit: Unit, seen: list[Sighting], bent: float) -> None:
    """From the 2 cm of a file to the 1 cm of returns; but not if each ring is bent along itself, its own way."""
    rng = np.random.default_rng(22)
    given = replace(unit.sensor, range_noise=0.02)
    views = []
    for one in seen:
        scan, ring = one.returns, one.returns.ring
        assert ring is not None
        azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
        middle = np.bincount(ring, azimuth, 16) / np.bincount(ring, minlength=16).clip(1)
        wave = np.sin(40 * (azimuth - middle[ring])) * (bent * rng.normal(size=16))[ring]
        away = scan.points / np.linalg.norm(scan.points, axis=1, keepdims=True)
        wavy = replace(scan, points=scan.points + wave[:, None] * away, sensor=given)
        views.append(Seen.of(wavy, one.estimate.target, 0, one.estimate.T_target_lidar))
    sampled = sampling(views, 16)
    assert sampled.smooth_noise is not None
    if bent:
        assert sampled.smooth_noise > 0.03
        assert sampled.noise_over(0.02) == pytest.approx(0.02, abs=0.004)
    else:
        assert sampled.smooth_noise == pytest.approx(0.01, rel=0.1)
        assert sampled.noise_over(0.02) == pytest.approx(0.01, rel=0.1)
    assert replace(sampled, smooth_noise=None).noise_over(0.05) == 0.05


def test_too_few_placements(seen: list[Sighting], unit: Unit) -> None:
    with pytest.raises(EstimationError, match="needs 6 placements"):
        calibrate_placements(gather(seen[:2]), unit.sensor)
