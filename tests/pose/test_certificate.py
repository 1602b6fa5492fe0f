"""The relaxation: its constraints, its bound, and the same problem through cvxpy."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import EstimationError, SensorModel
from optshape_graph.factors import TemplateMeasurement, edge_rows, plane_rows
from optshape_graph.io import load_target
from optshape_graph.pose import certify, estimate_pose, solve_relaxation
from optshape_graph.pose.certificate import eliminate_translation, rotation_constraints
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
