"""Generated camera sessions: what a calibration finds is the truth, to within its covariance."""

import json
from dataclasses import replace

import cv2
import gtsam
import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.calibration.camera.calibrate import calibrate
from optshape_graph.calibration.camera.session import read_views
from optshape_graph.calibration.images.chessboard import chessboard_points
from optshape_graph.calibration.images.projection import project
from optshape_graph.evaluation.camera_session import synthetic_camera_session
from optshape_graph.evaluation.rendering import render_target
from optshape_graph.io import load_sensor, load_session
from optshape_graph.se3 import inverse
from tests.calibration.camera.support import BOARD, PINHOLE, T_CAMERA_LIDAR
from tests.io.schema_support import complaint

CAMERA = replace(
    PINHOLE, name="front", width=1200, height=900, K=np.array([[800.0, 0, 590], [0, 805.0, 455], [0, 0, 1]])
)


def test_the_calibration_of_a_generated_session_is_its_truth(tmp_path):
    path = synthetic_camera_session(tmp_path / "s", BOARD, load_sensor("vlp16"), CAMERA, T_CAMERA_LIDAR, views=7)
    truth = json.loads((tmp_path / "s/truth.json").read_text())
    assert np.allclose(truth["T_camera_lidar"], T_CAMERA_LIDAR)
    for name in ("truth.json", "session.yaml", "target.yaml", "camera.yaml"):
        assert complaint(tmp_path / "s" / name) is None
    calibration = calibrate(read_views(load_session(path)))
    assert all(result.used for result in calibration.views)
    T, covariance = calibration.transform("front", calibration.lidars[0])
    xi = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(T) @ T_CAMERA_LIDAR))
    assert xi @ np.linalg.solve(covariance, xi) < 22.5  # chi-square, 6 degrees of freedom, 99.9 %
    for result in calibration.views:
        (sighting,) = [s for s in calibration.sightings if s.seen is result.view.scan]
        expected = np.array(truth["T_lidar_target"][result.view.scan_name])
        assert np.linalg.norm(sighting.T_sensor_target[:3, 3] - expected[:3, 3]) < 0.05


def test_the_same_seed_makes_the_same_session(tmp_path):
    for name in ("a", "b"):
        synthetic_camera_session(tmp_path / name, BOARD, load_sensor("vlp16"), CAMERA, T_CAMERA_LIDAR, views=1, rng=3)
    for path in (tmp_path / "a").iterdir():
        if path.name != "session.yaml":  # holds the folder's name
            assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_a_camera_that_looks_away_is_refused(tmp_path):
    away = np.diag([-1.0, 1.0, -1.0, 1.0]) @ T_CAMERA_LIDAR
    with pytest.raises(InputError, match="camera 'front' does not see target 'board'"):
        synthetic_camera_session(tmp_path, BOARD, load_sensor("vlp16"), CAMERA, away)


def test_a_rendered_board_has_its_corners_where_they_project():
    T = T_CAMERA_LIDAR @ np.array([[1.0, 0, 0, 2.5], [0, 0.8, -0.6, 0.0], [0, 0.6, 0.8, 0], [0, 0, 0, 1]])
    image = render_target(BOARD, CAMERA, T)
    assert image.shape == (900, 1200)
    corners = project(CAMERA, chessboard_points(BOARD.chessboard) @ T[:3, :3].T + T[:3, 3])
    refined = cv2.cornerSubPix(
        image, corners.astype(np.float32).reshape(-1, 1, 2).copy(), (7, 7), (-1, -1), (cv2.TERM_CRITERIA_COUNT, 30, 0)
    )
    assert np.abs(refined.reshape(-1, 2) - corners).max() < 0.3


def test_what_cannot_be_in_the_image_is_refused():
    behind = T_CAMERA_LIDAR @ np.array([[1.0, 0, 0, -2.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    with pytest.raises(InputError, match="not ahead"):
        render_target(BOARD, CAMERA, behind)
    beside = T_CAMERA_LIDAR @ np.array([[1.0, 0, 0, 2.5], [0, 1, 0, 9.0], [0, 0, 1, 0], [0, 0, 0, 1]])
    with pytest.raises(InputError, match="not in the image"):
        render_target(BOARD, CAMERA, beside)
