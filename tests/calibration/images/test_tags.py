from dataclasses import replace

import numpy as np
import pytest

from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.calibration.images.tags import find_tags, tag_points
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.evaluation.rendering import render_target
from optshape_graph.target import Tags
from tests.calibration.camera.support import BOARD, FISHEYE, T_CAMERA_LIDAR, placement

CENTRES = {3: (0.15, 0.2), 7: (-0.15, 0.2), 11: (0.0, -0.2)}


@pytest.mark.parametrize(("dictionary", "turn"), [("4X4_50", 0.0), ("APRILTAG_36h11", 0.3)])
def test_rendered_tags_give_the_pose_without_ambiguity(dictionary, turn):
    rng = np.random.default_rng(0)
    tags = Tags(dictionary, 0.2, CENTRES, turn)
    T = T_CAMERA_LIDAR @ placement(rng)
    image = render_target(replace(BOARD, chessboard=None, tags=tags), FISHEYE, T, rng)
    found = find_tags(image, tags)
    assert len(found) == 12
    assert len(found.symmetries) == 1
    pose = planar_poses(found, FISHEYE)[0]
    assert pose.rms_px < 0.5
    assert np.linalg.norm(pose.T_camera_target[:3, 3] - T[:3, 3]) < 5e-3
    assert np.degrees(np.arccos(pose.T_camera_target[:3, 2] @ T[:3, 2])) < 0.5


def test_tags_of_others_are_left_out():
    rng = np.random.default_rng(1)
    tags = Tags("4X4_50", 0.2, CENTRES)
    image = render_target(replace(BOARD, chessboard=None, tags=tags), FISHEYE, T_CAMERA_LIDAR @ placement(rng), rng)
    assert len(find_tags(image, replace(tags, centres={3: CENTRES[3], 40: (0.0, 0.0)}))) == 4
    with pytest.raises(EstimationError, match=r"tags \[3, 7, 11\] are in the image; the target has \[40\]"):
        find_tags(image, replace(tags, centres={40: (0.0, 0.0)}))


def test_unknown_dictionary_lists_the_known_ones():
    with pytest.raises(InputError, match=r"no tag dictionary '36h99'; expected one of .*APRILTAG_36h11"):
        find_tags(np.zeros((100, 100), np.uint8), Tags("36h99", 0.2, CENTRES))


def test_corners_of_an_upright_tag_run_clockwise_for_the_viewer():
    corners = tag_points(Tags("4X4_50", 0.2, {0: (0.0, 0.0)}), 0)
    # The viewer on the -x side has +y to the left: the first corner is top left, the second top right.
    assert np.allclose(corners, [[0, 0.1, 0.1], [0, -0.1, 0.1], [0, -0.1, -0.1], [0, 0.1, -0.1]])
