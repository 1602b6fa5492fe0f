"""Trajectory and landmark errors: alignment takes a frame away and nothing else; consistency is that of chi-square."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings

from optshape_graph import Target
from optshape_graph.errors import InputError
from optshape_graph.evaluation.trajectories import (
    absolute_error,
    align,
    associate,
    consistency_of,
    landmark_errors,
    pose_nees,
    predicted_rmse,
    relative_error,
)
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.mapping import Landmark, LandmarkSlam, Map, solve_batch
from optshape_graph.se3 import inverse
from optshape_graph.simulation import ConstantTwist
from tests.factors.support import TARGET, random_pose, retract, seeds
from tests.mapping.driving import Twisting, beside, drive, kitti_path
from tests.mapping.support import at, loop

PATH = loop(length=100.0, n_poses=50).poses


@settings(max_examples=20)
@given(seeds)
def test_alignment_takes_any_frame_away(seed):
    frame = random_pose(np.random.default_rng(seed), 2.0, 30.0)
    moved = frame @ PATH
    error = absolute_error(moved, PATH)
    assert error.translation.largest < 1e-9
    assert error.rotation.largest < 1e-6
    np.testing.assert_allclose(error.T_true_estimated, inverse(frame), atol=1e-9)
    assert absolute_error(moved, PATH, aligned=False).translation.rmse == pytest.approx(
        np.sqrt(np.square(moved[:, :3, 3] - PATH[:, :3, 3]).sum(axis=1).mean())
    )


def test_a_straight_path_is_aligned_by_its_orientations():
    line = np.array([at(float(x), 0.0, 0.0) for x in range(10)])
    turned = np.eye(4)
    turned[:3, :3] = gtsam.Rot3.Rx(1.0).matrix()
    np.testing.assert_allclose(align(turned @ line, line), inverse(turned), atol=1e-9)


def test_noise_is_measured_as_it_was_drawn():
    rng = np.random.default_rng(0)
    noisy = np.array([retract(T, np.concatenate([np.zeros(3), 0.1 * rng.normal(size=3)])) for T in PATH])
    error = absolute_error(noisy, PATH)
    # 50 poses x 3 axes of 0.1 m; alignment takes 6 of 150 degrees of freedom.
    assert error.translation.rmse == pytest.approx(0.1 * np.sqrt(3), rel=0.12)
    assert error.translation.count == 50
    assert error.translation.median <= error.translation.largest


def test_relative_error_of_a_known_drift():
    steps = [inverse(a) @ b for a, b in pairwise(PATH)]
    poses = [PATH[0]]
    for T in steps:
        scaled = T.copy()
        scaled[:3, 3] *= 1.01
        poses.append(poses[-1] @ scaled)
    error = relative_error(np.array(poses), PATH, 9.9)  # five steps of two metres
    assert error.translation.mean == pytest.approx(0.1, rel=0.02)
    assert error.rotation.largest < 1e-6
    with pytest.raises(InputError, match=r"98 m long|shorter than the 500 m"):
        relative_error(PATH, PATH, 500.0)
    with pytest.raises(InputError, match="above 0"):
        relative_error(PATH, PATH, 0.0)


def test_stamps_are_matched_to_the_nearest():
    a = Trajectory(PATH, np.arange(50.0))
    b = Trajectory(PATH[::2], np.arange(0.0, 50.0, 2.0) + 0.01)
    estimated, true = associate(a, b, tolerance=0.02)
    np.testing.assert_allclose(estimated, true)
    assert len(estimated) == 25
    with pytest.raises(InputError, match="no stamps"):
        associate(a, Trajectory(PATH, np.arange(50.0) + 1000.0))
    with pytest.raises(InputError, match="one of them has none"):
        associate(a, Trajectory(PATH))


def test_landmarks_are_compared_modulo_symmetry():
    square = Target.from_polygon([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)], "square")
    T = random_pose(np.random.default_rng(3))
    quarter = np.eye(4)
    quarter[:3, :3] = square.symmetry_transforms[1, :3, :3]
    C = np.diag(np.square([0.01, 0.02, 0.03, 0.01, 0.02, 0.03]))
    xi = np.array([0.01, 0.0, 0.0, 0.0, 0.02, 0.0])
    estimated = Map((Landmark("a", square, retract(T, xi) @ quarter, C), Landmark("b", TARGET, T, C)))
    [error] = landmark_errors(estimated, {"a": (square, T)})
    assert error.position == pytest.approx(0.02, rel=1e-2)
    assert error.rotation == pytest.approx(0.01, rel=1e-6)
    turned = gtsam.Pose3(quarter).AdjointMap()
    expected = xi @ np.linalg.solve(turned @ C @ turned.T, xi)
    assert error.nees == pytest.approx(expected, rel=1e-2)


def test_right_covariances_give_one():
    rng = np.random.default_rng(4)
    root = np.tril(0.02 * rng.normal(size=(6, 6))) + 0.02 * np.eye(6)
    C = np.tile(root @ root.T, (2000, 1, 1))
    true = np.array([random_pose(rng) for _ in range(2000)])
    estimated = np.array([retract(T, -(root @ rng.normal(size=6))) for T in true])
    result = consistency_of(pose_nees(estimated, true, C))
    assert result.low < 1.0 < result.high
    # 12,000 degrees of freedom: the mean is within 4 x sqrt(2 / 12000) of 1.
    assert result.per_dof == pytest.approx(1.0, abs=4 * np.sqrt(2 / 12000))
    measured = np.sqrt(np.square(estimated[:, :3, 3] - true[:, :3, 3]).sum(axis=1).mean())
    assert predicted_rmse(C) == pytest.approx(measured, rel=0.05)
    with pytest.raises(InputError, match="no normalised errors"):
        consistency_of(np.array([]))
    with pytest.raises(InputError, match="as many"):
        absolute_error(true[:3], true[:4])


def test_a_real_path_past_targets_in_simulated_scans():
    """Every second pose of half of KITTI's path that GTSAM ships, the scans taken on the move, poses estimated."""
    path = kitti_path()[:68:2]
    driven = drive(path, beside(path, 6), seed=1)
    slam = driven.feed(LandmarkSlam(confirmations=1))
    solution = solve_batch(slam.problem())
    estimated = solution.trajectory("session")
    true = Trajectory(path, np.arange(len(path), dtype=float))
    error = absolute_error(*associate(estimated, true))
    odometry = absolute_error(driven.dead_reckoning(), path)
    assert len(solution.landmarks) >= 5
    assert error.translation.rmse < 0.4 * odometry.translation.rmse
    assert relative_error(estimated.poses, path, 10.0).translation.rmse < 0.1
    joint = np.array([solution.covariance(poses=[("session", k)]) for k in range(1, len(path), 3)])
    nees = pose_nees(estimated.poses[1::3], path[1::3], joint)
    assert nees.mean() / 6 < 2.5  # one drive: neighbouring poses err together


@given(seeds)
def test_the_motion_of_the_drives_is_a_constant_twist(seed):
    rng = np.random.default_rng(seed)
    T, twist, times = random_pose(rng), rng.normal(size=6), rng.uniform(-1.0, 1.0, 5)
    for found, expected in zip(Twisting(T, twist).at(times), ConstantTwist(T, twist).at(times), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)
