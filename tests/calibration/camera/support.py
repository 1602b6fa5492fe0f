"""Synthetic calibration sessions with known truth: simulated scans, and corners projected with noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.factors import OFFSET_SIGMA_M
from optshape_graph.calibration.camera.scans import target_in_scan
from optshape_graph.calibration.camera.sightings import TargetInScan, View
from optshape_graph.calibration.images.chessboard import chessboard_points
from optshape_graph.calibration.images.image_points import ImagePoints, turn_about
from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.calibration.images.projection import project
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.io import load_sensor
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation.noise import NoiseModel
from optshape_graph.simulation.rays import AngleErrors
from optshape_graph.simulation.scene import simulate_target
from optshape_graph.target import Chessboard, Target

BOARD = Target(
    np.array([[0, 0.305, -0.425], [0, 0.305, 0.425], [0, -0.305, 0.425], [0, -0.305, -0.425]], float),
    "board",
    Chessboard((7, 5), 0.095, (0.002, 0.0)),
)
FISHEYE = CameraIntrinsics(
    "cam", "equidistant", 1920, 1208, np.array([[1177.0, 0, 962], [0, 1178.0, 613], [0, 0, 1]]),
    np.array([-0.054, -0.078, 0.096, -0.052]),
)  # fmt: skip
PINHOLE = CameraIntrinsics(
    "cam", "pinhole", 1600, 1200, np.array([[1100.0, 0, 790], [0, 1105.0, 605], [0, 0, 1]]),
    np.array([-0.21, 0.07, 3e-4, -2e-4]),
)  # fmt: skip
CORNER_NOISE_PX = 0.2


def transform(rotation: Floats, translation: Floats) -> Floats:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation from LiDAR axes (x forward, y left, z up) to camera axes (z forward, x right, y down)."""

T_CAMERA_LIDAR = transform(AXES @ Rotation.from_rotvec([0.03, 0.07, -0.05]).as_matrix(), np.array([0.01, -0.13, -0.08]))


@dataclass(frozen=True)
class Sensor:
    """A simulated LiDAR with the errors of its rings that it keeps, to which all boards are equally bright."""

    name: str
    model: SensorModel
    noise: NoiseModel
    range_bias: Floats
    angle_errors: AngleErrors

    @classmethod
    def drawn(cls, name: str, rng: np.random.Generator, mean_bias: float = 0.0) -> Sensor:
        model = replace(load_sensor("vlp16"), brightness_bias=0.0, blooming=0.0)
        noise = replace(NoiseModel.of(model), odd_ends=0.0)
        bias = mean_bias + noise.draw_range_bias(model.n_rings, rng)
        return cls(name, model, noise, bias, noise.draw_angle_errors(model.n_rings, rng))


def placement(rng: np.random.Generator, tilt: float = 0.5) -> Floats:
    """T_lidar_target of a board hung by a corner, somewhere in front of the sensors and turned at random."""
    centre = np.array([rng.uniform(1.7, 3.0), rng.uniform(-0.9, 0.9), rng.uniform(-0.15, 0.15)])
    yaw = np.arctan2(centre[1], centre[0]) + rng.uniform(-tilt, tilt)
    angles = [yaw, rng.uniform(-tilt, tilt), rng.uniform(0.5, 0.9)]
    return transform(Rotation.from_euler("ZYX", angles).as_matrix(), centre)


def seen_by_lidar(sensor: Sensor, T_lidar_target: Floats, target: Target, rng: np.random.Generator) -> TargetInScan:
    scan = simulate_target(
        target, sensor.model, T_lidar_target, noise=sensor.noise, rng=rng, range_bias=sensor.range_bias,
        angle_errors=sensor.angle_errors,
    )  # fmt: skip
    return target_in_scan(scan, target, sensor.name)


def seen_by_camera(
    camera: CameraIntrinsics,
    T_camera_target: Floats,
    target: Target,
    rng: np.random.Generator,
    name: str = "image",
    glued: Floats | None = None,
) -> TargetInImage:
    """Corners with noise, in an order that is arbitrary as to half a turn; `glued` is how far off the pattern is."""
    board = target.chessboard
    assert board is not None
    points = chessboard_points(board)
    pixels = project(
        camera, (points + (0.0 if glued is None else glued)) @ T_camera_target[:3, :3].T + T_camera_target[:3, 3]
    )
    pixels = pixels + rng.normal(0, CORNER_NOISE_PX, pixels.shape)
    if rng.random() < 0.5:
        pixels = pixels[::-1]
    turns = tuple(turn_about(board.offset, k * np.pi) for k in (0, 1))
    image = ImagePoints.of_pattern(points, pixels, CORNER_NOISE_PX, turns)
    return TargetInImage(camera, name, image, planar_poses(image, camera))


def synthetic_views(
    n: int,
    rng: np.random.Generator,
    camera: CameraIntrinsics = FISHEYE,
    mean_bias: float = 0.0,
    tilt: float = 0.5,
    target: Target = BOARD,
    placements: list[Floats] | None = None,
) -> list[View]:
    sensor = Sensor.drawn("lidar", rng, mean_bias)
    glued = rng.normal(0.0, OFFSET_SIGMA_M)
    views = []
    for k, T in enumerate(placements or [placement(rng, tilt) for _ in range(n)]):
        scan = seen_by_lidar(sensor, T, target, rng)
        image = seen_by_camera(camera, T_CAMERA_LIDAR @ T, target, rng, f"{k:02d}.png", glued)
        views.append(View(str(k), target, scan, image, f"{k:02d}.pcd", f"{k:02d}.png"))
    return views
