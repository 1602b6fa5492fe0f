"""A camera's projection by OpenCV's two lens models, over arrays of points.

`pinhole` is OpenCV's radial-tangential (or rational) model, `equidistant` its fisheye model (Kannala and Brandt,
PAMI 2006). Camera frame: x right, y down, z forward; pixels (u, v) from the centre of the top left one.
"""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Bools, Floats
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.io.image_files import opencv

NEWTON_STEPS = 10
NEGLIGIBLE_PX = 1e-7

WIDEST = np.radians(89.0)
"""Angle from the optical axis beyond which no lens is taken to see."""


def project(camera: CameraIntrinsics, points: Floats) -> Floats:
    """Return the pixels (N, 2) of points (N, 3), metres, camera frame, in front of the camera."""
    return projected(camera, points, np.zeros(3), np.zeros(3))[0]


def projection_derivative(camera: CameraIntrinsics, points: Floats) -> Floats:
    """Return the derivative (N, 2, 3) of the pixels by points (N, 3), pixels per metre, camera frame."""
    return projected(camera, points, np.zeros(3), np.zeros(3))[1][:, :, 3:]


def in_view(camera: CameraIntrinsics, points: Floats) -> Bools:
    """Return which of points (N, 3), metres, camera frame, the lens can see: where its model still leads outwards.

    Beyond some angle a distortion polynomial turns back, and would draw what is beside the image, or behind the
    camera, into it.
    """
    angles = np.arctan2(np.linalg.norm(points[:, :2], axis=1), points[:, 2])
    return np.asarray(angles < widest_angle(camera))


def widest_angle(camera: CameraIntrinsics) -> float:
    """Return the angle from the optical axis, rad, up to which a lens model maps larger angles farther out."""
    angles = np.linspace(0.0, WIDEST, 2000)
    D = np.zeros(8)
    D[: len(camera.D)] = camera.D
    if camera.model == "equidistant":
        radii = angles * (1 + np.polyval([*D[3::-1], 0.0], angles**2))
    else:
        squared = np.tan(angles) ** 2
        radii = np.tan(angles) * (1 + np.polyval([D[4], D[1], D[0], 0.0], squared))
        radii = radii / (1 + np.polyval([D[7], D[6], D[5], 0.0], squared))
    back = np.diff(radii) <= 0
    return float(angles[back.argmax()] if back.any() else WIDEST)


def normalised(camera: CameraIntrinsics, pixels: Floats) -> Floats:
    """Return x / z and y / z (N, 2) of the rays through pixels (N, 2)."""
    cv2 = opencv()
    undistort = cv2.fisheye.undistortPoints if camera.model == "equidistant" else cv2.undistortPoints
    image = np.ascontiguousarray(pixels, dtype=float).reshape(-1, 1, 2)
    rays = np.asarray(undistort(image, np.array(camera.K), _distortion(camera)), dtype=float).reshape(-1, 2)
    # OpenCV stops early for strong distortion: Newton steps finish it.
    for _ in range(NEWTON_STEPS):
        on_plane = np.column_stack([rays, np.ones(len(rays))])
        errors = project(camera, on_plane) - pixels
        if np.abs(errors).max(initial=0.0) < NEGLIGIBLE_PX:
            break
        rays = rays - np.linalg.solve(projection_derivative(camera, on_plane)[:, :, :2], errors[..., None])[..., 0]
    return rays


def projected(camera: CameraIntrinsics, points: Floats, rotation: Floats, translation: Floats) -> tuple[Floats, Floats]:
    """Return pixels (N, 2) and their derivative (N, 2, 6) by (rotation vector, translation) of T_camera_points."""
    cv2 = opencv()
    objects = np.ascontiguousarray(points, dtype=float).reshape(-1, 1, 3)
    if camera.model == "equidistant":
        pixels, jacobian = cv2.fisheye.projectPoints(
            objects, rotation.reshape(3, 1), translation.reshape(3, 1), np.array(camera.K), _distortion(camera)
        )
        motion = jacobian[:, 8:14]  # columns: f (2), c (2), k (4), rotation (3), translation (3), skew
    else:
        pixels, jacobian = cv2.projectPoints(objects, rotation, translation, np.array(camera.K), _distortion(camera))
        motion = jacobian[:, :6]
    return np.asarray(pixels, float).reshape(-1, 2), np.asarray(motion, float).reshape(-1, 2, 6)


def _distortion(camera: CameraIntrinsics) -> Floats:
    return np.array(camera.D) if len(camera.D) else np.zeros(4)
