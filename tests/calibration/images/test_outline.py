from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from optshape_graph.calibration.images.outline import fit_outline
from optshape_graph.calibration.images.planar_pose import refine_pose
from optshape_graph.errors import EstimationError
from optshape_graph.evaluation.rendering import render_target
from optshape_graph.target import Target
from tests.calibration.camera.support import BOARD, FISHEYE, T_CAMERA_LIDAR, placement, transform

PLAIN = replace(BOARD, chessboard=None)
TRIANGLE = Target.from_polygon([(-0.5, -0.3), (0.5, -0.35), (0.05, 0.5)], "triangle")


@pytest.mark.parametrize("target", [PLAIN, TRIANGLE], ids=lambda t: t.name)
@pytest.mark.parametrize("seed", [0, 1])
def test_outline_from_a_rough_start(target, seed):
    rng = np.random.default_rng(seed)
    T = T_CAMERA_LIDAR @ placement(rng)
    image = render_target(target, FISHEYE, T, rng)
    nudge = transform(Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix(), rng.normal(0, 0.015, 3))
    points = fit_outline(image, target, FISHEYE, T @ nudge)
    pose = refine_pose(points, FISHEYE, T @ nudge)
    error = T[:3, :3].T @ (pose.T_camera_target[:3, 3] - T[:3, 3])
    assert np.abs(error[1:]).max() < 1e-3
    assert abs(error[0]) < 5e-3  # depth follows from the size: a tenth of a pixel in 400
    assert np.degrees(np.arccos(pose.T_camera_target[:3, 0] @ T[:3, 0])) < 0.5
    sd = np.sqrt(np.diag(np.linalg.inv(pose.information)))
    assert (np.abs(error) < 5 * sd[3:]).all()


def test_no_edges_are_said():
    blank = np.full((FISHEYE.height, FISHEYE.width), 80, np.uint8)
    with pytest.raises(EstimationError, match="0 of 4 edges"):
        fit_outline(blank, PLAIN, FISHEYE, T_CAMERA_LIDAR @ placement(np.random.default_rng(0)))


def test_symmetries_are_the_targets():
    rng = np.random.default_rng(5)
    T = T_CAMERA_LIDAR @ placement(rng)
    assert len(fit_outline(render_target(PLAIN, FISHEYE, T, rng), PLAIN, FISHEYE, T).symmetries) == 2
    assert len(fit_outline(render_target(TRIANGLE, FISHEYE, T, rng), TRIANGLE, FISHEYE, T).symmetries) == 1
