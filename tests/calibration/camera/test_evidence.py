"""The errors of a view, by their definitions, on a view made for the purpose."""

import numpy as np
import pytest

from optshape_graph.calibration.camera.evidence import CrossValidation, ViewErrors, view_errors, without_bias
from optshape_graph.calibration.camera.graph import Rig, Sighting
from optshape_graph.calibration.images.projection import project
from optshape_graph.se3 import inverse
from tests.calibration.camera.support import (
    BOARD,
    FISHEYE,
    T_CAMERA_LIDAR,
    Sensor,
    placement,
    seen_by_camera,
    seen_by_lidar,
    transform,
)


def test_definitions():
    rng = np.random.default_rng(0)
    T = placement(rng)
    scan, image = (
        seen_by_lidar(Sensor.drawn("l", rng), T, BOARD, rng),
        seen_by_camera(FISHEYE, T_CAMERA_LIDAR @ T, BOARD, rng),
    )
    bias, extrinsic = 0.012, T_CAMERA_LIDAR @ transform(np.eye(3), np.array([0.01, 0.0, 0.0]))
    rig = Rig({"l": np.eye(4), "cam": inverse(extrinsic)}, {}, {"l": bias}, {"cam": FISHEYE})
    C = image.poses[0].T_camera_target
    lidar = Sighting((0,), "l", 0, scan, "board", np.eye(4), scan.T_lidar_target, scan.covariance)
    camera = Sighting((0,), "cam", 0, image, "board", np.eye(4), C, np.linalg.inv(image.poses[0].information))
    errors = view_errors(lidar, camera, BOARD, rig)

    centre = extrinsic @ np.append(scan.T_lidar_target[:3, 3] - bias * scan.ray, 1.0)
    assert errors.centre_error_mm == pytest.approx(1e3 * np.linalg.norm(centre[:3] - C[:3, 3]))
    shorter = scan.returns * (1 - bias / np.linalg.norm(scan.returns, axis=1, keepdims=True))
    centroid = extrinsic[:3, :3] @ shorter.mean(axis=0) + extrinsic[:3, 3]
    assert errors.plane_offset_mm == pytest.approx(1e3 * C[:3, 0] @ (centroid - C[:3, 3]))
    normal = extrinsic[:3, :3] @ scan.T_lidar_target[:3, 0]
    assert errors.normal_error_deg == pytest.approx(np.degrees(np.arccos(normal @ C[:3, 0])))
    corners = [project(FISHEYE, BOARD.vertices @ X[:3, :3].T + X[:3, 3]) for X in (extrinsic @ scan.pose(bias), C)]
    distances = np.linalg.norm(corners[0] - corners[1], axis=1)
    assert errors.reprojection_px == pytest.approx(np.sqrt((distances**2).mean()))


def test_bias_is_subtracted_from_ranges():
    points = np.array([[3.0, 4.0, 0.0]])
    assert np.linalg.norm(without_bias(points, 0.02)) == pytest.approx(4.98)


def test_means_are_of_signed_and_absolute_offsets():
    errors = {0: ViewErrors(1.0, 2.0, 3.0, 4.0), 1: ViewErrors(3.0, -4.0, 5.0, 6.0)}
    means = CrossValidation("leave-one-out", errors).means()
    assert means["mean_centre_error_mm"] == 2.0
    assert means["mean_signed_plane_offset_mm"] == -1.0
    assert means["mean_absolute_plane_offset_mm"] == 3.0
    assert CrossValidation("leave-one-out", {}).means() == {}
