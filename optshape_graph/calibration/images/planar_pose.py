"""The pose of a planar target from points in one image: both minima of the reprojection error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.projection import normalised, project, projected, projection_derivative
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import EstimationError
from optshape_graph.io.image_files import opencv
from optshape_graph.se3 import apply, skew

SAME_POSE = (np.radians(0.5), 2e-3)
"""Rotation, rad, and translation relative to the distance, under which two minima are one."""

YZX = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Target frame to the frame with the target in z = 0, which the homography decomposition expects."""


@dataclass(frozen=True, eq=False, repr=False)
class PlanarPose(Value):
    """A minimum of the reprojection error.

    Attributes:
        T_camera_target: (4, 4).
        information: (6, 6) of its right perturbation, rotation first, for the stated noise of the pixels.
        rms_px: root mean square distance between the pixels and the projected points.
    """

    T_camera_target: Floats
    information: Floats
    rms_px: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_camera_target", frozen(self.T_camera_target))
        object.__setattr__(self, "information", frozen(self.information))


def planar_poses(image: ImagePoints, camera: CameraIntrinsics) -> tuple[PlanarPose, ...]:
    """Find the poses of a planar target that explain its points in an image.

    A plane seen in weak perspective has two poses that fit nearly as well (Collins and Bartoli, IJCV 2014, whose
    method OpenCV provides as IPPE). Both start a refinement in pixels, through the lens model, and are returned
    where they do not end in the same minimum.

    Args:
        image: at least four points of the target, not on one line, with their pixels.
        camera: the intrinsics.

    Returns:
        One or two poses with the target in front of the camera and its -x side to it, the better one first.

    Raises:
        EstimationError: fewer than four points, points on one line, or no pose in front of the camera.
    """
    if len(image) < 4:
        raise EstimationError(f"{len(image)} points in the image; a planar pose needs at least 4")
    if np.linalg.svd(image.points - image.points.mean(axis=0), compute_uv=False)[1] < 1e-6:
        raise EstimationError("the points in the image lie on one line of the target")
    cv2 = opencv()
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        image.points @ YZX.T, normalised(camera, image.pixels), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    poses: list[PlanarPose] = []
    for rotation, translation in zip(rotations, translations, strict=True):
        start = np.eye(4)
        start[:3, :3] = cv2.Rodrigues(rotation)[0] @ YZX
        start[:3, 3] = np.ravel(translation)
        pose = refine_pose(image, camera, start)
        if _faces_camera(pose.T_camera_target) and not any(_same(pose, other) for other in poses):
            poses.append(pose)
    if not poses:
        plane, pixels = (each - each.mean(axis=0) for each in (image.points[:, 1:], image.pixels))
        mirrored = np.linalg.det(np.linalg.lstsq(plane, pixels, rcond=None)[0]) < 0
        why = ": its points are numbered the other way round, or the image shows its back" if mirrored else ""
        raise EstimationError(f"no pose puts the target in front of the camera with its -x side to it{why}")
    return tuple(sorted(poses, key=lambda pose: pose.rms_px))


def refine_pose(image: ImagePoints, camera: CameraIntrinsics, T_camera_target: Floats) -> PlanarPose:
    """Minimise the whitened reprojection error from a start (4, 4)."""
    W, points, pixels = image.sqrt_information, image.points, image.pixels

    def residual(x: Floats) -> Floats:
        errors = projected(camera, points, x[:3], x[3:])[0] - pixels
        return np.asarray(np.einsum("nij,nj->ni", W, errors).ravel())

    def derivative(x: Floats) -> Floats:
        return np.asarray((W @ projected(camera, points, x[:3], x[3:])[1]).reshape(-1, 6))

    start = np.concatenate([Rotation.from_matrix(T_camera_target[:3, :3]).as_rotvec(), T_camera_target[:3, 3]])
    x = least_squares(residual, start, jac=derivative, method="lm").x
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]
    return pose_at(image, camera, T)


def pose_at(image: ImagePoints, camera: CameraIntrinsics, T_camera_target: Floats) -> PlanarPose:
    """Return the information and the reprojection error of a pose (4, 4)."""
    errors = project(camera, apply(T_camera_target, image.points)) - image.pixels
    _, J = whitened_errors(image, camera, T_camera_target)
    return PlanarPose(T_camera_target, J.T @ J, float(np.sqrt((errors**2).sum(axis=1).mean())))


def whitened_errors(image: ImagePoints, camera: CameraIntrinsics, T_camera_target: Floats) -> tuple[Floats, Floats]:
    """Return the whitened errors (2 m,) at a pose (4, 4), and their derivative (2 m, 6) by its right perturbation."""
    R, t = T_camera_target[:3, :3], T_camera_target[:3, 3]
    in_camera = image.points @ R.T + t
    errors = np.einsum("nij,nj->ni", image.sqrt_information, project(camera, in_camera) - image.pixels)
    motion = np.concatenate([-R @ skew(image.points), np.broadcast_to(R, (len(image), 3, 3))], axis=2)
    J = (image.sqrt_information @ projection_derivative(camera, in_camera) @ motion).reshape(-1, 6)
    return errors.ravel(), J


def _faces_camera(T_camera_target: Floats) -> bool:
    return bool(T_camera_target[2, 3] > 0 and T_camera_target[:3, 0] @ T_camera_target[:3, 3] > 0)


def _same(a: PlanarPose, b: PlanarPose) -> bool:
    A, B = a.T_camera_target, b.T_camera_target
    turn = Rotation.from_matrix(A[:3, :3].T @ B[:3, :3]).magnitude()
    shift = np.linalg.norm(A[:3, 3] - B[:3, 3]) / np.linalg.norm(A[:3, 3])
    return bool(turn < SAME_POSE[0] and shift < SAME_POSE[1])
