"""Rigs with known truth: different LiDARs and cameras, and their views of targets all around."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.images.projection import in_view, project
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import EstimationError
from optshape_graph.io import load_sensor, load_target, save_camera, save_sensor, save_target, write_scan
from optshape_graph.io.documents import write_yaml
from optshape_graph.io.files import write_atomically
from optshape_graph.scan import Scan
from optshape_graph.se3 import apply, inverse, rotation, transform
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation import AngleErrors, NoiseModel, Patch, Scene, simulate, simulate_target
from optshape_graph.target import Target

AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation of axes x forward, y left, z up into those of a camera, z forward, x right, y down."""

CORNER_PX = 0.2
"""Standard deviation of a corner's coordinate in an image, pixels."""

ANGLE_ERROR = np.radians(0.05)
"""Standard deviation of the errors of each ring's elevation and azimuth, rad."""

MAKES = {"roof": "os1-64", "front": "vlp16", "rear": "vlp32c"}
PLACES: dict[str, tuple[Sequence[float], Sequence[float]]] = {
    "roof": ([0.0, 0.0, 0.45], [0.0, 0.0, 0.0]),
    "front": ([0.5, 0.1, 0.1], [10.0, 4.0, -3.0]),
    "rear": ([-0.6, -0.1, 0.15], [175.0, -3.0, 2.0]),
    "left": ([0.3, 0.3, 0.25], [40.0, 5.0, 0.0]),
    "right": ([0.3, -0.3, 0.25], [-45.0, 5.0, 0.0]),
}
"""Nominal poses of sensors on the platform: metres, and yaw, pitch and roll, degrees; a drawn rig deviates."""


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedRig(Value):
    """Sensors on a platform, with their constant errors.

    Attributes:
        lidars: sensor models by name, as a calibration gets them.
        cameras: intrinsics by name.
        T_base_sensor: (4, 4) of each.
        range_bias: (R,) of each LiDAR's rings, metres.
        angle_errors: of each LiDAR's rings.
    """

    lidars: Mapping[str, SensorModel]
    cameras: Mapping[str, CameraIntrinsics]
    T_base_sensor: Mapping[str, Floats]
    range_bias: Mapping[str, Floats]
    angle_errors: Mapping[str, AngleErrors]

    @classmethod
    def drawn(
        cls,
        rng: np.random.Generator,
        lidars: Mapping[str, str] | None = None,
        cameras: Sequence[str] = ("left", "right"),
    ) -> SimulatedRig:
        """Draw a rig: sensors near their nominal poses, with errors as large as their files state.

        Args:
            rng: source of randomness.
            lidars: built-in sensors by name; None: three different ones.
            cameras: names of the cameras.
        """
        models = {
            name: replace(load_sensor(make), elevation_error=ANGLE_ERROR, azimuth_error=ANGLE_ERROR)
            for name, make in (MAKES if lidars is None else lidars).items()
        }
        poses = {}
        for name in (*models, *cameras):
            place, ypr = PLACES[name]
            turn = Rotation.from_euler("ZYX", np.asarray(ypr) + rng.normal(0.0, 3.0, 3), degrees=True).as_matrix()
            poses[name] = transform(turn @ AXES.T if name in cameras else turn, place + rng.normal(0.0, 0.03, 3))
        lenses = {
            name: CameraIntrinsics(
                name, "pinhole", 1600, 1200, np.array([[800.0, 0, 795], [0, 802.0, 605], [0, 0, 1]]),
                np.array([-0.05, 0.01, 3e-4, -2e-4]),
            )
            for name in cameras
        }  # fmt: skip
        bias = {name: NoiseModel.of(m).draw_range_bias(m.n_rings, rng) for name, m in models.items()}
        angles = {name: NoiseModel.of(m).draw_angle_errors(m.n_rings, rng) for name, m in models.items()}
        return cls(models, lenses, poses, bias, angles)

    def pair(self, a: str, b: str) -> Floats:
        """Return T_a_b (4, 4) of two sensors."""
        return inverse(self.T_base_sensor[a]) @ self.T_base_sensor[b]

    def scan(self, lidar: str, target: Target, T_base_target: Floats, rng: np.random.Generator, name: str) -> Scan:
        """Return a LiDAR's returns on a target whose pose is T_base_target (4, 4), metres."""
        T = inverse(self.T_base_sensor[lidar]) @ T_base_target
        return simulate_target(
            target, self.lidars[lidar], T, noise=NoiseModel.of(self.lidars[lidar]), rng=rng,
            range_bias=self.range_bias[lidar], angle_errors=self.angle_errors[lidar], name=name,
        )  # fmt: skip

    def moving_scan(
        self, lidar: str, target: Target, path: Carried, start: float, rng: np.random.Generator, name: str
    ) -> Scan:
        """Return a LiDAR's returns on a moving target, of a revolution that begins at a time, seconds."""
        motion = _Relative(path, self.T_base_sensor[lidar], start)
        return simulate(
            Scene((Patch(target, np.eye(4)),)), self.lidars[lidar], motion, noise=NoiseModel.of(self.lidars[lidar]),
            rng=rng, range_bias=self.range_bias[lidar], angle_errors=self.angle_errors[lidar], name=name,
        ).scan  # fmt: skip

    def corners(
        self, camera: str, target: Target, T_base_target: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Floats] | None:
        """Return the points (m, 3) of a target's pattern and their pixels (m, 2); None unless all are in view."""
        lens, T = self.cameras[camera], inverse(self.T_base_sensor[camera]) @ T_base_target
        points = pattern(target)
        seen = apply(T, points)
        if (seen[:, 2] < 0.5).any() or not in_view(lens, seen).all():
            return None
        pixels = project(lens, seen)
        if (pixels < 5).any() or (pixels > (lens.width - 6, lens.height - 6)).any():
            return None
        return points, pixels + rng.normal(0.0, CORNER_PX, pixels.shape)


@dataclass(frozen=True, eq=False, repr=False)
class Carried(Value):
    """The motion of a target that is carried about: a sum of slow waves about a mean pose.

    Attributes:
        T_base_target: (4, 4) mean pose.
        sizes: (K, 6) amplitudes of the waves of each component of the motion, rotation first: rad and metres.
        rates: (K, 6) angular frequencies of the waves, rad/s.
        phases: (K, 6) of the waves, rad.
    """

    T_base_target: Floats
    sizes: Floats
    rates: Floats
    phases: Floats

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Carried:
        """Draw a motion at half a metre to a metre a second, about three metres ahead, with turns of up to 30 deg."""
        centre = np.array([rng.uniform(3.0, 3.6), rng.uniform(-0.3, 0.3), rng.uniform(0.0, 0.3)])
        turn = Rotation.from_euler("ZYX", [rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(-3, 3)])
        rates = rng.uniform(0.9, 1.6, (2, 6)) * np.array([[1.0], [1.7]])
        sizes = rng.uniform(0.7, 1.0, (2, 6)) * np.array([[0.25] * 3 + [0.45, 0.6, 0.2], [0.1] * 3 + [0.15, 0.2, 0.06]])
        return cls(transform(turn.as_matrix(), centre), sizes, rates, rng.uniform(0, 2 * np.pi, (2, 6)))

    def at(self, times: Floats) -> Floats:
        """Return T_base_target (N, 4, 4) at times (N,), seconds."""
        waves = (self.sizes * np.sin(self.rates * np.asarray(times)[:, None, None] + self.phases)).sum(axis=1)
        T = np.tile(self.T_base_target, (len(waves), 1, 1))
        T[:, :3, :3] = T[:, :3, :3] @ rotation(waves[:, :3])
        T[:, :3, 3] += waves[:, 3:]
        return T


@dataclass(frozen=True, eq=False, repr=False)
class _Relative(Value):
    """The motion of a sensor in the frame of a carried target."""

    carried: Carried
    T_base_sensor: Floats
    start: float

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        T = inverse(self.carried.at(times + self.start)) @ self.T_base_sensor
        return T[:, :3, :3], T[:, :3, 3]


def pattern(target: Target) -> Floats:
    """Return the points (m, 3) of a printed grid, metres, target frame, as far as they lie on the target."""
    steps = np.arange(-6, 7) * 0.1
    grid = np.array([(0.0, y, z) for y in steps for z in steps])
    return np.asarray(grid[target.contains(grid[:, 1:], margin=-0.05)])


def placements(
    n: int, rng: np.random.Generator, sector: tuple[float, float] = (-180.0, 180.0), count: int = 2
) -> list[list[Floats]]:
    """Return T_base_target (4, 4) of targets in `n` placements about a platform, 2.5 to 5 m away, turned at random.

    Args:
        n: number of placements.
        rng: source of randomness.
        sector: azimuths between which targets stand, deg.
        count: targets in a placement; they stand in different parts of the sector.
    """
    low, high = sector
    width = (high - low) / count
    found = []
    for _ in range(n):
        parts = rng.permutation(count)
        poses = []
        for part in parts:
            azimuth = np.radians(low + width * (part + rng.uniform(0.1, 0.9)))
            distance, height = rng.uniform(2.5, 5.0), rng.uniform(-0.1, 0.4)
            centre = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), height])
            ypr = [azimuth + rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), rng.uniform(-np.pi, np.pi)]
            poses.append(transform(Rotation.from_euler("ZYX", ypr).as_matrix(), centre))
        found.append(poses)
    return found


def write_rig_session(
    folder: str | Path,
    rig: SimulatedRig,
    targets: Mapping[str, Target],
    placed: Sequence[Sequence[Floats]],
    seed: int = 0,
) -> Path:
    """Write a session folder: crops of each target by every LiDAR that hits it, and corners in images.

    Args:
        folder: made if it is not there.
        rig: the sensors.
        targets: by name.
        placed: of each placement, T_base_target (4, 4) of each target.
        seed: of the noise.

    Returns:
        The path of session.yaml.

    Raises:
        EstimationError: no sensor sees a target.
    """
    folder, rng = Path(folder), np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    for name, sensor in rig.lidars.items():
        save_sensor(folder / f"{name}.sensor.yaml", sensor)
    for name, lens in rig.cameras.items():
        save_camera(folder / f"{name}.camera.yaml", lens)
    for name, target in targets.items():
        save_target(folder / f"{name}.target.yaml", target)
    views: list[dict[str, Any]] = []
    for k, poses in enumerate(placed):
        for (name, target), T in zip(targets.items(), poses, strict=True):
            for lidar in rig.lidars:
                file = f"{k:02d}_{lidar}_{name}.pcd"
                scan = rig.scan(lidar, target, T, rng, file)
                if len(scan) > 20:
                    write_scan(folder / file, scan)
                    views.append({"lidar": lidar, "scan": file, "target_points": file, "targets": [name], "stamp": k})
            for camera in rig.cameras:
                found = rig.corners(camera, target, T, rng)
                if found is not None:
                    file = f"{k:02d}_{camera}_{name}.csv"
                    rows = [
                        f"{y:.4f},{z:.4f},{u:.3f},{v:.3f},{CORNER_PX}" for (_, y, z), (u, v) in zip(*found, strict=True)
                    ]
                    write_atomically(folder / file, "\n".join(["y,z,u,v,sigma", *rows]) + "\n")
                    views.append({"camera": camera, "image": file, "targets": [name], "stamp": k})
    if not views:
        raise EstimationError(f"{folder}: no sensor saw a target")
    write_yaml(
        folder / "session.yaml",
        {
            "schema": "optshape/session/1",
            "lidars": {name: f"{name}.sensor.yaml" for name in rig.lidars},
            "cameras": {name: f"{name}.camera.yaml" for name in rig.cameras},
            "targets": {name: f"{name}.target.yaml" for name in targets},
            "views": views,
        },
    )
    return folder / "session.yaml"


def two_targets() -> dict[str, Target]:
    """Return two targets of a square metre: the paper's shape, and a square."""
    return {"A": load_target("paper@1.0"), "B": load_target("square@1.0")}
