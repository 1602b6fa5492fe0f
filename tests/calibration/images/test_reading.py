from dataclasses import replace

import cv2
import numpy as np
import pytest

from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.calibration.images.projection import project
from optshape_graph.calibration.images.reading import ImageTask, TargetInImage, find_target, find_targets
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.evaluation.rendering import render_target
from tests.calibration.camera.support import BOARD, FISHEYE, PINHOLE, T_CAMERA_LIDAR, placement

PLAIN = replace(BOARD, chessboard=None)


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    rng = np.random.default_rng(0)
    T = T_CAMERA_LIDAR @ placement(rng)
    path = tmp_path_factory.mktemp("images") / "board.png"
    cv2.imwrite(str(path), render_target(BOARD, FISHEYE, T, rng))
    return path, T


def test_several_images_keep_their_order_and_their_errors(picture, tmp_path):
    path, _ = picture
    broken = tmp_path / "broken.png"
    broken.write_bytes(path.read_bytes()[:100])
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((1208, 1920), 90, np.uint8))
    steps = []
    found = find_targets(
        [ImageTask(p, BOARD, FISHEYE) for p in (broken, path, blank, tmp_path / "no.png")], lambda: steps.append(1)
    )
    assert [type(one) for one in found] == [InputError, TargetInImage, EstimationError, InputError]
    assert "not an image that OpenCV can read (100 bytes)" in str(found[0])
    assert "no such file" in str(found[3])
    assert len(steps) == 4


def test_wrong_lens_model_is_noticed(picture):
    path, _ = picture
    wrong = replace(PINHOLE, width=1920, height=1208, K=FISHEYE.K, D=FISHEYE.D)
    with pytest.raises(InputError, match=r"are the intrinsics \('pinhole'\) those of camera 'cam'"):
        find_target(ImageTask(path, BOARD, wrong))


def test_wrong_size_is_noticed(picture):
    path, _ = picture
    with pytest.raises(InputError, match=r"1920 x 1208 pixels; the intrinsics of camera 'cam' are for 1600 x 1200"):
        find_target(ImageTask(path, BOARD, PINHOLE))


def test_unpatterned_target_needs_a_start(picture):
    path, _ = picture
    with pytest.raises(InputError, match="its outline needs a start"):
        find_target(ImageTask(path, PLAIN, FISHEYE))


def test_unpatterned_target_from_rough_corners(tmp_path):
    rng = np.random.default_rng(2)
    T = T_CAMERA_LIDAR @ placement(rng)
    image, corners = tmp_path / "plain.png", tmp_path / "plain.csv"
    cv2.imwrite(str(image), render_target(PLAIN, FISHEYE, T, rng))
    pixels = project(FISHEYE, PLAIN.vertices @ T[:3, :3].T + T[:3, 3]) + rng.normal(0, 4.0, (4, 2))
    corners.write_text("vertex,u,v\n" + "".join(f"{k},{u:.1f},{v:.1f}\n" for k, (u, v) in enumerate(pixels)))
    found = find_target(ImageTask(image, PLAIN, FISHEYE, corners))
    best = planar_poses(found.points, FISHEYE)[0]
    assert np.linalg.norm(best.T_camera_target[:3, 3] - T[:3, 3]) < 6e-3


def test_csv_instead_of_an_image(tmp_path):
    T = T_CAMERA_LIDAR @ placement(np.random.default_rng(3))
    pixels = project(FISHEYE, PLAIN.vertices @ T[:3, :3].T + T[:3, 3])
    file = tmp_path / "corners.csv"
    file.write_text("vertex,u,v\n" + "".join(f"{k},{u},{v}\n" for k, (u, v) in enumerate(pixels)))
    found = find_target(ImageTask(file, PLAIN, FISHEYE))
    assert np.allclose(found.poses[0].T_camera_target, T, atol=1e-5)
