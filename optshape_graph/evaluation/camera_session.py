"""Sessions with known truth: scans of a room with a board in it, and images of the board."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.calibration.images.projection import project
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.evaluation.rendering import render_target
from optshape_graph.io import save_camera, save_sensor, save_target, write_scan
from optshape_graph.io.documents import write_json, write_yaml
from optshape_graph.io.files import write_atomically
from optshape_graph.io.image_files import opencv
from optshape_graph.se3 import apply
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation import NoiseModel, room, simulate
from optshape_graph.target import Target

MOST_TRIES = 1000
"""Placements that are drawn at most to find one that the camera sees whole."""

MARGIN_PX = 20
"""Smallest distance of the target from the image's border."""


def synthetic_camera_session(
    folder: str | Path,
    target: Target,
    sensor: SensorModel,
    camera: CameraIntrinsics,
    T_camera_lidar: Floats,
    *,
    views: int = 10,
    distances: tuple[float, float] = (1.7, 3.0),
    tilt: float = 0.5,
    noise: NoiseModel | None = None,
    rng: np.random.Generator | int = 0,
) -> Path:
    """Write a session folder: full scans, images, session.yaml with target, sensor and camera files, and truth.json.

    The target hangs in a room by a corner, turned at random, where the camera sees it whole. Range biases of the rings
    are the same in all scans.

    Args:
        folder: made if it is not there.
        target: with a chessboard or tags.
        sensor: the LiDAR, at the origin, x ahead.
        camera: the camera.
        T_camera_lidar: (4, 4) the truth that a calibration is to find.
        views: number of views.
        distances: smallest and largest distance of the target from the LiDAR, along x, metres.
        tilt: largest rotation of the target away from facing the LiDAR, about either axis, rad.
        noise: of the LiDAR; None: that of the sensor's model.
        rng: generator or seed.

    Returns:
        The path of session.yaml.

    Raises:
        InputError: the camera does not see the target where the LiDAR does, or the folder cannot be written.
        MissingExtraError: OpenCV is absent.
    """
    cv2, folder, rng = opencv(), Path(folder), np.random.default_rng(rng)
    folder.mkdir(parents=True, exist_ok=True)
    noise = NoiseModel.of(sensor) if noise is None else noise
    range_bias = noise.draw_range_bias(sensor.n_rings, rng)
    entries, poses = [], {}
    for k in range(views):
        T = _placement(target, camera, T_camera_lidar, distances, tilt, rng)
        scan, image = f"{k:02d}.pcd", f"{k:02d}.png"
        seen = simulate(room([(target, T)]), sensor, noise=noise, rng=rng, range_bias=range_bias, name=scan)
        write_scan(folder / scan, seen.scan)
        picture = render_target(target, camera, T_camera_lidar @ T, rng)
        write_atomically(folder / image, cv2.imencode(".png", picture)[1].tobytes())
        entries.append({"scan": scan, "image": image})
        poses[scan] = T
    save_target(folder / "target.yaml", target)
    save_sensor(folder / "sensor.yaml", sensor)
    save_camera(folder / "camera.yaml", camera)
    truth = {"schema": "optshape/session-truth/1", "T_camera_lidar": T_camera_lidar, "T_lidar_target": poses}
    write_json(folder / "truth.json", truth | {"range_bias": range_bias})
    session = {
        "schema": "optshape/session/1", "name": folder.name, "sensor": "sensor.yaml", "target": "target.yaml",
        "camera": "camera.yaml", "views": entries,
    }  # fmt: skip
    write_yaml(folder / "session.yaml", session)
    return folder / "session.yaml"


def _placement(
    target: Target, camera: CameraIntrinsics, T_camera_lidar: Floats, distances: tuple[float, float], tilt: float,
    rng: np.random.Generator,
) -> Floats:  # fmt: skip
    """Return T_lidar_target (4, 4) of a target that the camera sees whole."""
    for _ in range(MOST_TRIES):
        x = rng.uniform(*distances)
        centre = np.array([x, x * rng.uniform(-0.4, 0.4), rng.uniform(-0.15, 0.15)])
        yaw = np.arctan2(centre[1], centre[0]) + rng.uniform(-tilt, tilt)
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("ZYX", [yaw, rng.uniform(-tilt, tilt), rng.uniform(0.5, 0.9)]).as_matrix()
        T[:3, 3] = centre
        in_camera = T_camera_lidar @ T
        vertices = apply(in_camera, target.vertices)
        if (vertices[:, 2] > 0.1).all():
            pixels = project(camera, vertices)
            if (pixels > MARGIN_PX).all() and (pixels < np.array([camera.width, camera.height]) - MARGIN_PX).all():
                return T
    raise InputError(f"camera '{camera.name}' does not see target '{target.name}' whole where the LiDAR does")
