from dataclasses import replace

import numpy as np
import pytest

from optshape_graph.calibration.images.chessboard import chessboard_points, find_chessboard
from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.calibration.images.reading import ImageTask, TargetInImage, find_targets, read_grey
from optshape_graph.errors import EstimationError
from optshape_graph.evaluation.rendering import render_target
from optshape_graph.io import load_session
from optshape_graph.io.documents import read_json
from optshape_graph.target import Chessboard
from tests.calibration.camera.support import BOARD, FISHEYE, PINHOLE, T_CAMERA_LIDAR, placement
from tests.shared import SHARED, needs_shared


def half_turned(T: np.ndarray, symmetries: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    return [T @ np.linalg.inv(S) for S in symmetries]


@pytest.mark.parametrize("camera", [FISHEYE, PINHOLE], ids=lambda c: c.model)
@pytest.mark.parametrize("seed", [0, 1])
def test_rendered_chessboard_gives_the_pose_it_was_rendered_at(camera, seed):
    rng = np.random.default_rng(seed)
    T = T_CAMERA_LIDAR @ placement(rng)
    found = find_chessboard(render_target(BOARD, camera, T, rng), BOARD.chessboard)
    pose = planar_poses(found, camera)[0]
    assert pose.rms_px < 0.15  # rendering with 2 x 2 samples a pixel, grey levels rounded
    error = min(
        np.linalg.norm(candidate[:3, 3] - T[:3, 3]) for candidate in half_turned(pose.T_camera_target, found.symmetries)
    )
    assert error < 3e-3


def test_either_order_of_the_corners_is_a_symmetry():
    rng = np.random.default_rng(3)
    T = T_CAMERA_LIDAR @ placement(rng)
    found = find_chessboard(render_target(BOARD, PINHOLE, T, rng), BOARD.chessboard)
    for S in found.symmetries:
        again = found.relabelled(S)
        assert np.allclose(np.sort(again.points, axis=0), np.sort(found.points, axis=0), atol=1e-12)
        assert planar_poses(again, PINHOLE)[0].rms_px == pytest.approx(planar_poses(found, PINHOLE)[0].rms_px, rel=1e-4)


def test_square_pattern_has_quarter_turns():
    rng = np.random.default_rng(4)
    T = T_CAMERA_LIDAR @ placement(rng)
    board = Chessboard((5, 5), 0.095)
    found = find_chessboard(render_target(replace(BOARD, chessboard=board), PINHOLE, T, rng), board)
    assert len(found.symmetries) == 4


def test_absent_chessboard_is_said():
    with pytest.raises(EstimationError, match="no chessboard of 7 x 5"):
        find_chessboard(np.full((300, 400), 128, np.uint8), BOARD.chessboard)


def test_points_are_centred_at_the_offset():
    points = chessboard_points(Chessboard((7, 5), 0.1, (0.01, -0.02)))
    assert points.shape == (35, 3)
    assert np.allclose(points.mean(axis=0), [0, 0.01, -0.02])
    assert np.allclose(np.ptp(points, axis=0), [0, 0.4, 0.6])


@needs_shared
def test_all_real_images_with_the_peers_poses():
    session = load_session(SHARED / "data/camera/session.yaml")
    (camera,), (target,) = session.cameras.values(), session.targets.values()
    found = find_targets([ImageTask(view.image, target, camera) for view in session.views])
    assert all(isinstance(one, TargetInImage) for one in found)
    peer = read_json(SHARED / "data/camera/peer_reference.json").value
    for view, one in zip(session.views, found, strict=True):
        assert one.poses[0].rms_px < 0.4  # corners to 0.1-0.3 px, intrinsics as published
        name = view.image.stem
        if name == "pose01":  # what the peer recorded there is of another moment than the image: see the next test
            continue
        candidates = half_turned(one.poses[0].T_camera_target, one.points.symmetries)
        normal = -one.poses[0].T_camera_target[:3, 0]
        centre = min(np.linalg.norm(1e3 * T[:3, 3] - peer[name]["camera_centre_mm"]) for T in candidates)
        assert centre < 4.0  # the pattern's offset, 2 mm, has an unknown sign
        assert np.degrees(np.linalg.norm(np.cross(normal, peer[name]["camera_normal"]))) < 0.2


@needs_shared
def test_slanted_real_view_lands_in_the_right_of_the_two_poses():
    """Judged by the LiDAR's plane of that view, moved by the other views' extrinsic; the peer's is 26 deg off."""
    session = load_session(SHARED / "data/camera/session.yaml")
    (camera,), (target,) = session.cameras.values(), session.targets.values()
    image = read_grey(session.views[0].image)
    points = find_chessboard(image, target.chessboard)
    normal = -planar_poses(points, camera)[0].T_camera_target[:3, 0]
    lidar_normal, R = (
        np.array([-0.744, -0.649, -0.158]),
        [
            [0.0735, -0.9970, 0.0240],
            [-0.1382, -0.0340, -0.9898],
            [0.9877, 0.0694, -0.1403],
        ],
    )
    lidar_normal = R @ lidar_normal / np.linalg.norm(lidar_normal)
    assert np.degrees(np.arccos(normal @ lidar_normal)) < 2.0
