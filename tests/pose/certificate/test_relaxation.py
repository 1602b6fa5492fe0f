"""The relaxation: its constraints, its bound, and the same problem through cvxpy."""

from typing import get_args

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optshape_graph import EstimationError, SensorModel
from optshape_graph.factors import TemplateMeasurement, edge_rows, plane_rows
from optshape_graph.factors.measurement import refine
from optshape_graph.io import load_target
from optshape_graph.pose import certify, estimate_pose, solve_relaxation
from optshape_graph.pose.certificate.relaxation import Backend, eliminate_translation, lower_bound, rotation_constraints
from optshape_graph.se3 import rotation, transform
from tests.pose.clouds import simulated


def random_measurement(seed: int, noise: float = 0.01) -> tuple[TemplateMeasurement, np.ndarray]:
    """Noisy points on the paper's template, seen from a random pose; and that T_target_lidar."""
    rng = np.random.default_rng(seed)
    target = load_target("paper")
    T = gtsam.Pose3.Expmap(np.concatenate([rng.uniform(-2, 2, 3), rng.uniform(-5, 5, 3)])).matrix()
    labels = np.repeat(np.arange(4), 6)
    s = rng.uniform(0, 1, (24, 1))
    on_edge = (1 - s) * target.vertices[labels] + s * np.roll(target.vertices, -1, axis=0)[labels]
    points = (on_edge + rng.normal(0, noise, on_edge.shape) - T[:3, 3]) @ T[:3, :3]
    A, r = edge_rows(points, target.normals[labels], target.offsets[labels])
    A_plane, r_plane = plane_rows(points)
    return TemplateMeasurement.from_rows(np.vstack([A, A_plane]), np.concatenate([r, r_plane]), T), T


@given(st.integers(0, 2**31 - 1))
def test_constraints_vanish_on_rotations_only(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R = gtsam.Rot3.Expmap(rng.uniform(-3, 3, 3)).matrix()
    mirrored = R @ np.diag([1.0, 1.0, -1.0])
    A = rotation_constraints()

    def values(M: np.ndarray) -> np.ndarray:
        x = np.append(M.T.ravel(), 1.0)
        return np.einsum("i,kij,j->k", x, A, x)

    np.testing.assert_allclose(values(R), 0, atol=1e-12)
    assert np.abs(values(mirrored)).max() > 0.3


@pytest.mark.parametrize("seed", range(8))
def test_bound_is_tight_and_below_every_pose(seed: int) -> None:
    measurement, T = random_measurement(seed)
    relaxation = solve_relaxation(measurement.quadratic())
    scale = float(np.trace(measurement.quadratic()))
    # Clarabel stops at a relative gap of 1e-10 of the scaled problem; the bound loses a few times that.
    assert relaxation.cost - relaxation.bound <= 1e-7 * scale
    assert relaxation.bound <= relaxation.cost + 1e-12 * scale
    rng = np.random.default_rng(seed)
    for _ in range(200):
        other = gtsam.Pose3.Expmap(rng.normal(0, 2, 6)).matrix()
        assert 2 * measurement.error(other) >= relaxation.bound
    assert np.abs(relaxation.T_target_lidar - T).max() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_cvxpy_agrees(seed: int) -> None:
    measurement, _ = random_measurement(seed)
    ours, oracle = (solve_relaxation(measurement.quadratic(), backend) for backend in ("clarabel", "cvxpy"))
    scale = float(np.trace(measurement.quadratic()))
    assert ours.bound == pytest.approx(oracle.bound, abs=1e-6 * scale)
    np.testing.assert_allclose(ours.T_target_lidar, oracle.T_target_lidar, atol=1e-6)


def test_translation_is_eliminated_exactly() -> None:
    measurement, _ = random_measurement(3)
    form, K = eliminate_translation(measurement.quadratic())
    R = gtsam.Rot3.Expmap(np.array([0.3, -0.2, 0.5])).matrix()
    x = np.append(R.T.ravel(), 1.0)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, K @ x
    assert x @ form @ x == pytest.approx(2 * measurement.error(T), rel=1e-9)
    moved = T.copy()
    moved[:3, 3] += [1e-3, -2e-3, 1e-3]
    assert measurement.error(moved) > measurement.error(T)


def test_nothing_to_estimate_is_an_error() -> None:
    with pytest.raises(EstimationError, match="no rotation"):
        solve_relaxation(np.zeros((13, 13)))


@pytest.mark.parametrize("backend", ["clarabel", "cvxpy"])
def test_a_wrong_pose_is_not_certified(backend: str) -> None:
    scan, _ = simulated(10.0, seed=4)
    estimate = estimate_pose(scan, load_target("paper"), backend=backend)
    assert estimate.certificate.certified
    weight = 1.0  # the gap is then in whitened units, far stricter than any weight of real rows makes it
    for step in (np.array([0.0, 0, 0, 0, 0.05, 0]), np.array([np.pi, 0, 0, 0, 0, 0]), np.full(6, 0.02)):
        wrong = estimate.T_target_lidar @ gtsam.Pose3.Expmap(step).matrix()
        certificate = certify(estimate.measurement, wrong, weight, backend)
        assert not certificate.certified
        assert certificate.gap_m2 > 1e-4


def test_gap_of_a_wrong_pose_in_square_metres() -> None:
    """A pose 2 cm off costs what 2 cm cost, spread over all rows: far more than (0.1 mm)^2."""
    scan, _ = simulated(6.0, seed=5)
    estimate = estimate_pose(scan, load_target("paper"))
    sensor = scan.sensor
    assert isinstance(sensor, SensorModel)
    weight = float((1 / estimate.edge_sigma**2).sum()) + len(scan) / sensor.range_noise**2
    wrong = estimate.T_target_lidar @ gtsam.Pose3.Expmap(np.array([0, 0, 0, 0, 0.02, 0.0])).matrix()
    certificate = certify(estimate.measurement, wrong, weight)
    assert not certificate.certified
    assert 1e-8 < certificate.gap_m2 < 0.02**2


def few_points(seed: int) -> tuple[TemplateMeasurement, np.ndarray]:
    """Two noisy points each on three edges, and those of the plane, at the best pose in front; and points (6, 3)."""
    rng = np.random.default_rng(seed)
    target = load_target("paper")
    T = gtsam.Pose3.Expmap(np.concatenate([rng.normal(0, 0.4, 3), [-6.0, 0.0, 0.0]])).matrix()
    labels = np.repeat(rng.choice(4, 3, replace=False), 2)
    s = rng.uniform(0, 1, (6, 1))
    on_edge = (1 - s) * target.vertices[labels] + s * np.roll(target.vertices, -1, axis=0)[labels]
    points = (on_edge + rng.normal(0, 0.08, on_edge.shape) * [0.05, 1.0, 1.0] - T[:3, 3]) @ T[:3, :3]
    A, r = edge_rows(points, target.normals[labels], target.offsets[labels])
    A_plane, r_plane = plane_rows(points)
    measurement = TemplateMeasurement.from_rows(
        np.vstack([A / 0.02, A_plane / 0.005]), np.concatenate([r / 0.02, r_plane / 0.005]), T
    )
    return measurement.at(min(minima(measurement, T, True), key=measurement.error)), points


def minima(measurement: TemplateMeasurement, T: np.ndarray, in_front: bool) -> list[np.ndarray]:
    """Where descents from turns of a pose about its normal, and from behind, end on one side of the target."""
    starts = [rotation(np.array([turn, 0.0, 0.0])) for turn in np.linspace(0, 2 * np.pi, 16, endpoint=False)]
    starts += [R @ np.diag([-1.0, 1.0, -1.0]) for R in starts]
    found = [refine(measurement.at(transform(R) @ T)) for R in starts]
    return [T for T in found if (T[0, 3] < 0) == in_front]


FROM_BEHIND = (2, 14, 16, 17, 22, 40, 46, 53, 56, 58)
"""Seeds of `few_points`, all below 60 with which a pose seen from behind costs less than every one in front."""


@pytest.mark.slow
def test_a_pose_from_behind_is_no_rival() -> None:
    """No pose is certified against all; against those in front nine of ten, by every backend alike."""
    certified = 0
    for seed in FROM_BEHIND:
        measurement, _ = few_points(seed)
        T, Q = measurement.T_target_lidar, measurement.quadratic()
        cost = 2 * measurement.error(T)
        assert 2 * min(map(measurement.error, minima(measurement, T, False))) < cost - 1e-3
        assert lower_bound(Q).bound < cost - 1e-3
        verdicts = {certify(measurement, T, 1e6, backend).certified for backend in get_args(Backend)}
        assert len(verdicts) == 1
        certified += verdicts.pop()
    assert certified >= 9


@pytest.mark.slow
@given(st.integers(0, 2**31 - 1))
@settings(max_examples=25)
def test_the_bound_in_front_holds_for_every_pose_in_front(seed: int) -> None:
    """Whatever rotation it was made for."""
    rng = np.random.default_rng(seed)
    measurement, _ = few_points(seed % 50)
    T = measurement.T_target_lidar
    made_for = gtsam.Rot3.Expmap(rng.normal(0, 1, 3)).matrix() @ T[:3, :3]
    bound = lower_bound(measurement.quadratic(), R_in_front=made_for).bound
    for _ in range(50):
        other = gtsam.Pose3.Expmap(rng.normal(0, 1, 6)).matrix() @ T
        assert other[0, 3] > 0 or 2 * measurement.error(other) >= bound - 1e-6 * abs(bound)
    assert 2 * measurement.error(T) >= bound - 1e-6


def test_a_pose_from_behind_is_not_certified_by_what_is_in_front() -> None:
    """It is compared with all poses."""
    measurement, _ = few_points(3)
    behind = min(minima(measurement, measurement.T_target_lidar, False), key=measurement.error)
    assert behind[0, 3] > 0
    moved = behind.copy()
    moved[1, 3] += 0.1
    assert not certify(measurement, moved, 1e6).certified
