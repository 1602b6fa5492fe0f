import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from optshape_graph.calibration.consensus import relative_pose, rigid_fit
from tests.calibration.camera.support import transform

HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])


def random_pose(rng: np.random.Generator, scale: float = 2.0) -> np.ndarray:
    return transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-scale, scale, 3))


def noisy(T: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return T @ transform(Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix(), rng.normal(0, 0.005, 3))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_symmetric_targets_and_bad_views(seed):
    """Any relative pose, candidate lists shuffled, a quarter of the views wrong: found, and the wrong ones named."""
    rng = np.random.default_rng(seed)
    truth = random_pose(rng)
    a, b, wrong = [], [], rng.permutation(12)[:3]
    for v in range(12):
        T_b = random_pose(rng)
        T_a = random_pose(rng) if v in wrong else noisy(truth @ T_b, rng)
        a.append(np.stack([T_a, T_a @ HALF_TURN])[rng.permutation(2)])
        b.append(T_b[None])
    found = relative_pose(a, b)
    assert set(np.flatnonzero(~found.inlier)) == set(wrong)
    assert np.linalg.norm(found.T_a_b[:3, 3] - truth[:3, 3]) < 0.03
    assert found.runner_up - found.cost > 20


def test_one_symmetric_view_is_ambiguous():
    rng = np.random.default_rng(0)
    T = random_pose(rng)
    found = relative_pose([np.stack([T, T @ HALF_TURN])], [np.eye(4)[None]])
    assert found.runner_up == pytest.approx(found.cost, abs=1e-6)


def test_rigid_fit_is_exact_without_noise_and_equivariant():
    rng = np.random.default_rng(1)
    truth, other = random_pose(rng), random_pose(rng)
    B = np.stack([random_pose(rng) for _ in range(5)])
    fit = rigid_fit(truth @ B, B, np.full(5, 0.05), 0.05)
    assert np.allclose(fit, truth, atol=1e-12)
    A = np.stack([noisy(T, rng) for T in truth @ B])
    moved = rigid_fit(other @ A, B, np.full(5, 0.05), 0.05)
    assert np.allclose(moved, other @ rigid_fit(A, B, np.full(5, 0.05), 0.05), atol=1e-9)
