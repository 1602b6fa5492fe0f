"""Where to put the target next: the placement that would sharpen an extrinsic most."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.graph import Sighting
from optshape_graph.calibration.camera.observability import principal_directions
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.planar_pose import pose_at
from optshape_graph.calibration.images.projection import normalised, project
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.se3 import adjoint, apply, inverse
from optshape_graph.target import Target

COLUMNS, ROWS = (0.15, 0.5, 0.85), (0.3, 0.5, 0.7)
"""Where in the image the target's centre is tried, in shares of its width and height."""

DISTANCES = (0.7, 1.0, 1.5)
"""Distances from the camera that are tried, in shares of the median one so far."""

TILTS_DEG = (-35.0, 0.0, 35.0)
"""Angles about the vertical and about the horizontal by which the target is tried turned from facing the LiDAR."""


@dataclass(frozen=True, eq=False, repr=False)
class NextPlacement(Value):
    """A placement of the target that was not taken yet.

    Attributes:
        T_lidar_target: (4, 4).
        yaw_deg: turn about the vertical from facing the LiDAR.
        pitch_deg: tilt about the horizontal.
        worst: the extrinsic's worst direction now, in words.
        sigma_m: its standard deviation now, metres.
        expected_sigma_m: the worst direction's standard deviation with a view of this placement, metres.
    """

    T_lidar_target: Floats
    yaw_deg: float
    pitch_deg: float
    worst: str
    sigma_m: float
    expected_sigma_m: float


def suggest_placement(
    target: Target,
    pairs: Sequence[tuple[Sighting, Sighting]],
    camera: CameraIntrinsics,
    T_camera_lidar: Floats,
    covariance: Floats,
) -> NextPlacement | None:
    """Try placements over the image, at several distances and tilts, and return the one that helps most.

    The LiDAR is expected to measure a placement as well as it measured the view of the nearest range, and the image to
    show the points that the images so far show.

    Args:
        target: the target to place.
        pairs: scan and image of every view used.
        camera: the intrinsics.
        T_camera_lidar: (4, 4).
        covariance: (6, 6) of its right perturbation, rotation first.

    Returns:
        The placement, or None where no placement tried lies in both fields of view.
    """
    scans = [scan for scan, _ in pairs if isinstance(scan.seen, TargetInScan)]
    points = max((i.seen.points for _, i in pairs if isinstance(i.seen, TargetInImage)), key=len)
    poses = np.stack([scan.T_sensor_target for scan in scans])
    centre, information = poses[:, :3, 3].mean(axis=0), np.linalg.inv(covariance)
    now = principal_directions(covariance, centre)[0]
    best: NextPlacement | None = None
    for T_lidar_target, yaw, pitch in _placements(target, poses, camera, T_camera_lidar):
        nearest = min(scans, key=lambda s: abs(_range(s.T_sensor_target) - _range(T_lidar_target)))
        added = _information(nearest, points, camera, T_camera_lidar, T_lidar_target)
        after = principal_directions(np.asarray(np.linalg.inv(information + added)), centre)[0].sigma_m
        if best is None or after < best.expected_sigma_m:
            best = NextPlacement(T_lidar_target, yaw, pitch, now.text, now.sigma_m, after)
    return best


def _placements(
    target: Target, poses: Floats, camera: CameraIntrinsics, T_camera_lidar: Floats
) -> Iterator[tuple[Floats, float, float]]:
    """Yield T_lidar_target, yaw and pitch of placements that lie in the image, their centres in the LiDAR's view."""
    T_lidar_camera = inverse(T_camera_lidar)
    distance = float(np.median(np.linalg.norm(apply(T_camera_lidar, poses[:, :3, 3]), axis=1)))
    elevations = np.arcsin(poses[:, 2, 3] / np.linalg.norm(poses[:, :3, 3], axis=1))
    low, high = elevations.min() - np.radians(3), elevations.max() + np.radians(3)
    roll = _median_roll(poses)
    cells = np.array(list(product(COLUMNS, ROWS))) * (camera.width, camera.height)
    rays = np.column_stack([normalised(camera, cells), np.ones(len(cells))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for ray, share, yaw, pitch in product(rays, DISTANCES, TILTS_DEG, TILTS_DEG):
        T = np.eye(4)
        T[:3, 3] = T_lidar_camera[:3, :3] @ (ray * share * distance) + T_lidar_camera[:3, 3]
        facing = np.arctan2(T[1, 3], T[0, 3])
        T[:3, :3] = Rotation.from_euler("ZYX", [facing + np.radians(yaw), np.radians(pitch), roll]).as_matrix()
        if not low <= np.arcsin(T[2, 3] / _range(T)) <= high:
            continue
        vertices = (T_camera_lidar @ T @ np.column_stack([target.vertices, np.ones(len(target))]).T)[:3].T
        if (vertices[:, 2] <= 0.1 * distance).any():
            continue
        pixels = project(camera, vertices)
        if (pixels >= 0).all() and (pixels <= (camera.width - 1, camera.height - 1)).all():
            yield T, yaw, pitch


def _information(
    scan: Sighting, points: ImagePoints, camera: CameraIntrinsics, T_camera_lidar: Floats, T_lidar_target: Floats
) -> Floats:
    """Return the information (6, 6) on T_camera_lidar that a view of a placement would add."""
    image = pose_at(points, camera, T_camera_lidar @ T_lidar_target).information
    relative = np.linalg.inv(scan.covariance + np.linalg.inv(image))
    # T_camera_target Exp(xi) T_lidar_target^-1 = T_camera_lidar Exp(Ad(T_lidar_target) xi)
    back = adjoint(inverse(T_lidar_target))
    return np.asarray(back.T @ relative @ back)


def _range(T: Floats) -> float:
    return float(np.linalg.norm(T[:3, 3]))


def _median_roll(poses: Floats) -> float:
    """Return the circular mean of the targets' turn about their own normals, rad: how the target hangs."""
    rolls = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX")[:, 2]
    return float(np.angle(np.exp(1j * rolls).mean()))
