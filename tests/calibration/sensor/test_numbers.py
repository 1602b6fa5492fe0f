"""What was asked of a sensor's calibration, over simulated units and the recorded sessions.

`python -m pytest -m benchmark -s tests/calibration/sensor`. An hour of processor time: a unit takes five to forty
seconds, most of them to make its Gaussians again in the company of the solution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import SensorCalibration, SensorModel, calibrate_mocap, calibrate_sensor
from optshape_graph._arrays import Floats
from optshape_graph.calibration.sensor import Distance, Sighting, calibrate_placements, gather
from optshape_graph.calibration.sensor.graph import Joint, solve
from optshape_graph.calibration.sensor.seen import Seen
from optshape_graph.calibration.sensor.told import MEAN_RANGE
from optshape_graph.calibration.sensor.unknowns import EDGE_SYSTEMATIC
from optshape_graph.factors import AZIMUTH, EDGE_OFFSET, ELEVATION, RANGE_BIAS, fuse_static, refine
from optshape_graph.io import load_session, load_target
from optshape_graph.pose import PoseEstimate, estimate_pose, estimate_poses
from optshape_graph.scan import Scan
from optshape_graph.se3 import apply, difference, inverse, inverse_covariance
from optshape_graph.simulation import pose_from_rpy
from tests.calibration.sensor.units import ANGLE, Unit, sightings
from tests.shared import SHARED, needs_shared

pytestmark = pytest.mark.benchmark

UNITS = 20
"""Copies of each sensor."""

DISTANCES = 20
"""Units of whose mean range a distance tells; a mean of so few squares scatters by 0.3."""

CALIBRATED = 8
"""Units by whose calibration fresh scans are judged: all scans of one share its errors."""

FRESH = 64
"""Scans at each distance; a quarter as many places for ten revolutions."""

SEED = 77


def solved(seen: list[Sighting]) -> Joint:
    placements = gather(seen)
    start = {p: one.sightings[0].estimate.T_target_lidar for p, one in enumerate(placements)}
    views = [
        Seen.of(one.returns, placement.target, p, start[p])
        for p, placement in enumerate(placements)
        for one in placement.sightings
    ]
    return solve(views, start)


@pytest.mark.parametrize(
    ("sensor", "low", "high", "elevation"),
    [
        ("vlp16", 3, 15, 0.022), ("vlp32c", 3, 15, 0.018), ("os1-64", 3, 15, 0.026),
        ("vlp16", 3, 6, 0.018), ("vlp32c", 3, 6, 0.015), ("os1-64", 3, 6, 0.018),
    ],
)  # fmt: skip
def test_rings(sensor: str, low: float, high: float, elevation: float) -> None:
    """60 scans of three boards: ring ranges to 2 mm, elevations to so many degrees, NEES / dof 0.7 to 1.3.

    Of rings that were seen, about their mean, which is the frame's or the file's.
    """
    squares, nees = [], []
    for k in range(UNITS):
        rng = np.random.default_rng([SEED, k])
        unit = Unit.drawn(sensor, rng)
        joint = solved(sightings(unit, 60, low, high, rng))
        off, covariance = unit.errors(joint)
        errors = [e for e in joint.errors if e.kind in (RANGE_BIAS, ELEVATION, AZIMUTH, EDGE_OFFSET)]
        edge = next(i for i, error in enumerate(errors) if error.kind == EDGE_OFFSET)
        covariance[edge, edge] += (EDGE_SYSTEMATIC / unit.sensor.edge_offset_sd) ** 2
        nees.append(off @ np.linalg.solve(covariance, off) / len(off))
        row = []
        for kind, sd in ((RANGE_BIAS, 10.0), (ELEVATION, np.degrees(ANGLE)), (AZIMUTH, np.degrees(ANGLE))):
            index = [i for i, error in enumerate(errors) if error.kind == kind and covariance[i, i] < 0.7**2]
            of_kind = sd * off[index]
            row.append(np.mean((of_kind - of_kind.mean()) ** 2))
        squares.append(row)
    ranges, elevations, azimuths = np.sqrt(np.mean(squares, axis=0))
    print(
        f"{sensor} {low}-{high} m: {ranges:.2f} mm, {elevations:.4f} and {azimuths:.4f} deg, NEES {np.mean(nees):.2f}"
    )
    assert ranges <= 2.0
    assert elevations <= elevation
    assert 0.7 <= np.mean(nees) <= 1.3


def test_one_distance_tells_the_mean_range() -> None:
    """To 2 mm rms, and as well as is stated, of units whose ranges are all off by a centimetre more than any file says.

    The two boards stand elsewhere in the other scans, where the distance does not hold.
    """
    off, squares = [], []
    for k in range(DISTANCES):
        rng = np.random.default_rng([SEED + 1, k])
        unit = Unit.drawn("vlp32c", rng)
        unit = replace(unit, range_bias=unit.range_bias + 0.01 * rng.normal())
        seen = sightings(unit, 25, 2, 6, rng)
        poses = (
            pose_from_rpy([4, 0, 0], [0.3, 0.1, 0.1]),
            pose_from_rpy([0, 0, 0], [0, 0, np.pi]) @ pose_from_rpy([4.5, 0, 0.1], [1.0, -0.1, 0.1]),
        )
        for moment in range(25, 33):
            for name, T in zip(("paper", "square"), poses, strict=True):
                returns = unit.scan(load_target(name), T, rng)
                seen.append(Sighting(moment, "measured", estimate_pose(returns, load_target(name)), returns))
        metres = float(np.linalg.norm(poses[0][:3, 3] - poses[1][:3, 3])) + 0.002 * rng.normal()
        result = calibrate_placements(
            gather(seen), unit.sensor, [Distance.parsed("paper", "square", f"{metres}@measured")]
        )
        assert result.sensor.range_bias is not None
        known = result.sensor.range_bias_sds < 0.7 * unit.sensor.range_bias_sds
        off.append(float(np.mean((result.sensor.range_bias - unit.range_bias)[known])))
        (stated,) = (one.sd for one in result.directions if one.name == MEAN_RANGE)
        squares.append((off[-1] / stated) ** 2)
    print(f"mean range: {1e3 * np.sqrt(np.mean(np.square(off))):.2f} mm rms, NEES {np.mean(squares):.2f}")
    assert np.sqrt(np.mean(np.square(off))) <= 2e-3
    assert 0.7 <= np.mean(squares) <= 1.3


def of_pose(T: Floats, found: Floats, covariance: Floats) -> tuple[float, float]:
    """Mean square distance of the paper's vertices, m2, and NEES / dof."""
    vertices, x = load_target("paper").vertices, difference(T, found)
    square = ((apply(T, vertices) - apply(found, vertices)) ** 2).sum(axis=1).mean()
    return float(square), float(x @ np.linalg.solve(covariance, x)) / 6


@pytest.fixture(scope="module")
def units() -> list[tuple[Unit, SensorCalibration]]:
    found = []
    for k in range(CALIBRATED):
        rng = np.random.default_rng([SEED + 2, k])
        unit = Unit.drawn("vlp32c", rng)
        found.append((unit, calibrate_placements(gather(sightings(unit, 60, 3, 15, rng)), unit.sensor)))
    return found


ASKED = {5: (5.2, 3.0), 10: (9.3, 5.0), 20: (20.5, 10.0)}
"""Millimetres of a fresh scan, and of ten revolutions, by metres."""


@pytest.mark.parametrize("distance", ASKED)
def test_fresh_scans(distance: float, units: list[tuple[Unit, SensorCalibration]]) -> None:
    rows: dict[str, list[tuple[float, float]]] = {"given": [], "calibrated": [], "known": []}
    for number, (unit, result) in enumerate(units):
        for k in range(FRESH // len(units)):
            rng = np.random.default_rng([SEED + 3, int(distance), number, k])
            T = pose_from_rpy([distance, *rng.normal(0, 0.3, 2)], np.radians(rng.uniform(-25, 25, 3)))
            returns = unit.scan(load_target("paper"), T, rng)
            for name, sensor in (("given", unit.sensor), ("calibrated", result.sensor), ("known", unit.known)):
                estimate = estimate_pose(replace(returns, sensor=sensor), load_target("paper"))
                if estimate.status == "ok":
                    rows[name].append(of_pose(T, estimate.T_lidar_target, estimate.covariance))
    rms, nees = told(f"{distance} m", rows)
    assert rms["calibrated"] <= ASKED[int(distance)][0]
    assert 0.8 <= nees["calibrated"] <= 1.2
    assert nees["given"] <= 1.2


@pytest.mark.parametrize("distance", ASKED)
def test_ten_revolutions(distance: float, units: list[tuple[Unit, SensorCalibration]]) -> None:
    rows: dict[str, list[tuple[float, float]]] = {"given": [], "calibrated": [], "known": []}
    for number, (unit, result) in enumerate(units):
        for k in range(FRESH // len(units) // 4):
            rng = np.random.default_rng([SEED + 4, int(distance), number, k])
            T = pose_from_rpy([distance, *rng.normal(0, 0.3, 2)], np.radians(rng.uniform(-25, 25, 3)))
            returns = [unit.scan(load_target("paper"), T, rng) for _ in range(10)]
            for name, sensor in (("given", unit.sensor), ("calibrated", result.sensor), ("known", unit.known)):
                row = fused(T, [replace(one, sensor=sensor) for one in returns])
                if row is not None:
                    rows[name].append(row)
    rms, _ = told(f"{distance} m, ten revolutions", rows)
    assert rms["calibrated"] <= ASKED[int(distance)][1]


def fused(T: Floats, returns: list[Scan]) -> tuple[float, float] | None:
    estimates = estimate_poses(returns, load_target("paper"))
    ok = [one for one in estimates if isinstance(one, PoseEstimate) and one.status == "ok"]
    if len(ok) < 8:
        return None
    whole = fuse_static([measured for one in ok if (measured := one.of_scene) is not None], 1.0)
    T_target_lidar = refine(whole.at(ok[0].T_target_lidar))
    covariance = inverse_covariance(T_target_lidar, np.linalg.inv(whole.information(T_target_lidar)))
    return of_pose(T, inverse(T_target_lidar), covariance)


def told(what: str, rows: Mapping[str, list[tuple[float, float]]]) -> tuple[dict[str, float], dict[str, float]]:
    """Print and return root mean squares, mm, and NEES / dof."""
    rms = {name: 1e3 * float(np.sqrt(np.mean([a for a, _ in of]))) for name, of in rows.items()}
    nees = {name: float(np.mean([b for _, b in of])) for name, of in rows.items()}
    print(what, *(f"{name}: {rms[name]:.1f} mm, NEES {nees[name]:.2f} ({len(rows[name])})" for name in rows), sep="; ")
    return rms, nees


@needs_shared
def test_recorded_sessions() -> None:
    """Calibrated on two, judged on the third, leave-one-out: RMSE 18.6 mm, 1.75 deg, NEES / dof 1.4."""
    path = str(SHARED / "data" / "mocap" / "session{}" / "session.yaml")
    rows: dict[str, list[tuple[float, float, float]]] = {"given": [], "calibrated": []}
    for left_out in (1, 3, 5):
        result = calibrate_sensor([path.format(k) for k in (1, 3, 5) if k != left_out])
        assert result.helps
        session = load_session(path.format(left_out))
        sensors: dict[str, SensorModel] = {"given": result.given, "calibrated": result.sensor}
        for name, sensor in sensors.items():
            judged = calibrate_mocap(replace(session, lidars=dict.fromkeys(session.lidars, sensor)))
            pairs = zip(judged.leave_one_out, judged.chi_square, strict=True)
            rows[name] += [(error.rmse_m, error.e_r_deg, chi_square / 6) for error, chi_square in pairs]
    for name, of in rows.items():
        print(name, np.round(np.mean(of, axis=0), 4))
    rmse, e_r, nees = np.mean(rows["calibrated"], axis=0)
    assert rmse <= 0.0186
    assert e_r <= 1.75
    assert nees <= 1.4
