import cv2
import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.calibration.images.projection import normalised, project, projection_derivative
from optshape_graph.errors import EstimationError
from tests.calibration.camera.support import (
    BOARD,
    CORNER_NOISE_PX,
    FISHEYE,
    PINHOLE,
    T_CAMERA_LIDAR,
    chessboard_points,
    placement,
    transform,
)

CAMERAS = pytest.mark.parametrize("camera", [FISHEYE, PINHOLE], ids=lambda c: c.model)


@CAMERAS
def test_projection_is_gtsams(camera):
    points = np.random.default_rng(0).uniform([-1, -0.7, 1], [1, 0.7, 3], (50, 3))
    K = camera.K
    values = [K[0, 0], K[1, 1], 0.0, K[0, 2], K[1, 2], *camera.D]
    model = gtsam.Cal3Fisheye(values) if camera.model == "equidistant" else gtsam.Cal3DS2(values)
    expected = [model.uncalibrate(p[:2] / p[2]) for p in points]
    assert np.allclose(project(camera, points), expected, atol=1e-9)
    assert np.allclose(normalised(camera, project(camera, points)), points[:, :2] / points[:, 2:], atol=1e-9)


@CAMERAS
def test_projection_derivative_is_the_numerical_one(camera):
    points = np.random.default_rng(1).uniform([-1, -0.7, 1], [1, 0.7, 3], (20, 3))
    J = projection_derivative(camera, points)
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        numeric = (project(camera, points + step) - project(camera, points - step)) / 2e-6
        assert np.allclose(J[:, :, k], numeric, rtol=1e-6, atol=1e-3)


def test_points_numbered_the_other_way_round_are_told():
    T = T_CAMERA_LIDAR @ placement(np.random.default_rng(0))
    points = chessboard_points(BOARD.chessboard)
    pixels = project(FISHEYE, points @ T[:3, :3].T + T[:3, 3])
    with pytest.raises(
        EstimationError, match="its points are numbered the other way round, or the image shows its back"
    ):
        planar_poses(ImagePoints.of_pattern(points * [1, -1, 1], pixels, CORNER_NOISE_PX), FISHEYE)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_the_true_pose_is_among_the_two_and_the_better_one_first(seed):
    rng = np.random.default_rng(seed)
    T = T_CAMERA_LIDAR @ placement(rng)
    points = chessboard_points(BOARD.chessboard)
    pixels = project(FISHEYE, points @ T[:3, :3].T + T[:3, 3])
    poses = planar_poses(ImagePoints.of_pattern(points, pixels, CORNER_NOISE_PX), FISHEYE)
    assert 1 <= len(poses) <= 2
    assert np.allclose(poses[0].T_camera_target, T, atol=1e-6)
    assert [pose.rms_px for pose in poses] == sorted(pose.rms_px for pose in poses)


def test_a_distant_slanted_target_has_a_second_pose_nearly_as_good():
    rng = np.random.default_rng(0)
    T = T_CAMERA_LIDAR @ transform(Rotation.from_euler("ZYX", [0.6, 0.2, 0.6]).as_matrix(), np.array([12.0, 0, 0]))
    points = chessboard_points(BOARD.chessboard)
    pixels = project(FISHEYE, points @ T[:3, :3].T + T[:3, 3]) + rng.normal(0, 0.2, (35, 2))
    poses = planar_poses(ImagePoints.of_pattern(points, pixels, 0.2), FISHEYE)
    assert len(poses) == 2
    assert poses[1].rms_px < 2 * poses[0].rms_px
    angles = [np.degrees(np.arccos(np.clip(pose.T_camera_target[:3, 0] @ T[:3, 0], -1, 1))) for pose in poses]
    assert min(angles) < 5.0 < 20.0 < max(angles)


def test_covariance_is_the_scatter():
    rng = np.random.default_rng(7)
    T = T_CAMERA_LIDAR @ placement(rng)
    points = chessboard_points(BOARD.chessboard)
    exact = project(FISHEYE, points @ T[:3, :3].T + T[:3, 3])
    errors = []
    for _ in range(100):
        image = ImagePoints.of_pattern(points, exact + rng.normal(0, 0.3, exact.shape), 0.3)
        pose = planar_poses(image, FISHEYE)[0]
        x = gtsam.Pose3.Logmap(gtsam.Pose3(T).between(gtsam.Pose3(pose.T_camera_target)))
        errors.append(x @ pose.information @ x)
    assert np.mean(errors) / 6 == pytest.approx(1.0, abs=0.25)  # chi-square of 600: sd 0.06; four of them


def test_too_little_is_said():
    line = np.column_stack([np.zeros(5), np.arange(5.0), np.zeros(5)])
    with pytest.raises(EstimationError, match="3 points"):
        planar_poses(ImagePoints.of_pattern(line[:3], np.zeros((3, 2)), 1.0), FISHEYE)
    with pytest.raises(EstimationError, match="on one line"):
        planar_poses(ImagePoints.of_pattern(line, np.arange(10.0).reshape(5, 2), 1.0), FISHEYE)


def test_opencv_is_of_the_tested_range():
    assert int(cv2.__version__.split(".")[0]) in (4, 5)
