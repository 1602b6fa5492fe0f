"""The closed-form dual: rigorous anywhere, tight at the minimum, and of one mind with the solver."""

from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optshape_graph.factors import TemplateMeasurement
from optshape_graph.io import load_target
from optshape_graph.pose import certify, estimate_pose, solve_relaxation
from optshape_graph.pose.certificate import certificates
from optshape_graph.pose.certificate.multipliers import closed_form_bounds
from optshape_graph.pose.certificate.relaxation import Bound, eliminate_translation, lower_bound, project_rotation
from tests.pose.certificate.test_relaxation import random_measurement
from tests.pose.clouds import recorded_cases, reference_cases, simulated
from tests.shared import needs_shared


def form_of(measurement: TemplateMeasurement) -> np.ndarray:
    form, _ = eliminate_translation(measurement.quadratic())
    return form / np.trace(form)


def cost(form: np.ndarray, R: np.ndarray) -> float:
    x = np.append(R.T.ravel(), 1.0)
    return float(x @ form @ x)


@given(st.integers(0, 2**31 - 1))
@settings(max_examples=50)
def test_the_bound_holds_wherever_it_is_taken(seed: int) -> None:
    """Multipliers for one rotation bound the cost of every other, minimum or not."""
    rng = np.random.default_rng(seed)
    form = form_of(random_measurement(seed)[0])
    rotations = np.array([gtsam.Rot3.Expmap(rng.uniform(-3, 3, 3)).matrix() for _ in range(20)])
    bounds, _ = closed_form_bounds(np.repeat(form[None], 20, axis=0), rotations)
    assert bounds.max() <= min(cost(form, R) for R in rotations) + 1e-12


@given(st.integers(0, 2**31 - 1))
@settings(max_examples=20)
def test_tight_at_the_minimum(seed: int) -> None:
    measurement, _ = random_measurement(seed)
    R = solve_relaxation(measurement.quadratic()).T_target_lidar[:3, :3]
    form = form_of(measurement)
    bound, second = closed_form_bounds(form[None], R[None])
    assert cost(form, R) - bound[0] == pytest.approx(0.0, abs=1e-9)
    assert second[0] > 0


@pytest.mark.parametrize("sensor", ["vlp16", "vlp32c", "os1-64"])
def test_three_backends_agree(sensor: str) -> None:
    scan, _ = simulated(6.0, (10.0, 20.0, 15.0), seed=1, sensor=sensor)
    certificates = [
        estimate_pose(scan, load_target("paper"), backend=name).certificate
        for name in ("closed-form", "clarabel", "cvxpy")
    ]
    assert all(c.certified for c in certificates)
    # A hundredth of what is still certified; cvxpy stops a hundred times earlier, see `test_cvxpy_agrees`.
    assert max(c.gap_m2 for c in certificates[:2]) <= 1e-5**2


@pytest.mark.slow
@needs_shared
def test_clouds_and_recordings_are_certified_without_a_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[np.ndarray] = []

    def noting(Q: np.ndarray, *of: Any) -> Bound:
        asked.append(Q)
        return lower_bound(Q, *of)

    monkeypatch.setattr(certificates, "lower_bound", noting)
    cases = [(case.scan, load_target("paper")) for case in reference_cases()] + list(recorded_cases())
    poses = [estimate_pose(scan, target) for scan, target in cases]
    assert len(poses) == 50
    assert all(pose.certificate.certified for pose in poses)
    assert len({Q.tobytes() for Q in asked}) <= 0.07 * 50


@pytest.mark.slow
def test_wrong_minima_are_not_certified() -> None:
    """Local minima near the half turns of the global one, which cost more."""
    wrong = 0
    for seed in range(60):
        measurement, _ = random_measurement(seed, noise=0.1)
        form, best = form_of(measurement), solve_relaxation(measurement.quadratic())
        lowest = cost(form, best.T_target_lidar[:3, :3])
        for half_turn in np.pi * np.eye(3):
            R = local_minimum(form, gtsam.Rot3.Expmap(half_turn).matrix() @ best.T_target_lidar[:3, :3])
            if cost(form, R) > lowest + 1e-6:
                wrong += 1
                bound, _ = closed_form_bounds(form[None], R[None])
                assert cost(form, R) - bound[0] > 0.9 * (cost(form, R) - lowest)
    assert wrong >= 30


def local_minimum(form: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Descend from a rotation by projected gradient steps."""
    step = 0.5 / np.linalg.eigvalsh(form[:9, :9])[-1]
    for _ in range(400):
        gradient = (form[:9] @ np.append(R.T.ravel(), 1.0)).reshape(3, 3).T
        R = project_rotation(R - step * gradient)
    return R


def test_what_it_cannot_tell_goes_to_the_solver() -> None:
    """Two edge directions leave a direction open: no multipliers are positive, and the solver's certificate counts."""
    measurement, T = random_measurement(3)
    rows = TemplateMeasurement.from_stack(measurement.stack[:4], 4, T)
    form = form_of(rows)
    bound, _ = closed_form_bounds(form[None], T[None, :3, :3])
    assert cost(form, T[:3, :3]) - bound[0] > 1e-4
    pose = solve_relaxation(rows.quadratic()).T_target_lidar
    assert certify(rows, pose, 1.0).gap_m2 == pytest.approx(
        max(0.0, 2 * rows.error(pose) - lower_bound(rows.quadratic()).bound), abs=1e-9
    )
