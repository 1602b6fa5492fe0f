"""Clouds of targets for the tests of pose/: published, recorded and generated."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache

import gtsam
import numpy as np

from optshape_graph import Scan, SensorModel, Target
from optshape_graph.calibration.mocap.comparison import align
from optshape_graph.io import load_sensor, load_target, read_scan
from optshape_graph.pose import PoseEstimate
from optshape_graph.simulation import NoiseModel, pose_from_rpy, simulate_target
from tests.shared import SHARED


@dataclass(frozen=True)
class Case:
    """A cloud with its truth and the published result on it."""

    name: str
    scan: Scan
    T_lidar_target: np.ndarray
    vertices: np.ndarray
    published_rmse: float
    published_e_r_deg: float


@cache
def reference_cases() -> tuple[Case, ...]:
    """The 40 noise-free clouds published with the paper's code, rings counted from the lowest elevation."""
    folder = SHARED / "reference"
    sensor, target = load_sensor(folder / "reference_simulator.sensor.yaml"), load_target("paper")
    published = {}
    with (folder / "sim_reference.csv").open() as file:
        for row in csv.DictReader(file):
            if row["noise_level"] == "0":
                face = float(row["roll"]) == 0
                published[round(float(row["x"])), face] = float(row["rmse_m"]), float(row["e_r_deg"])
    cases = []
    with np.load(folder / "sim_noisefree_clouds.npz") as clouds:
        for distance in range(2, 42, 2):
            for face, label in ((True, "face"), (False, "ext")):
                points = clouds[f"x{distance}_{label}_pts"]
                vertices = clouds[f"x{distance}_{label}_gtverts"]
                elevation = np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1))
                scan = Scan(points, sensor.nearest_ring(elevation), sensor=sensor, name=f"{distance} m {label}")
                rmse, e_r = published[distance, face]
                cases.append(Case(scan.name, scan, align(vertices, target.vertices), vertices, rmse, e_r))
    return tuple(cases)


@cache
def recorded_cases() -> tuple[tuple[Scan, Target], ...]:
    """The ten recorded scans of the built target."""
    folder, sensor = SHARED / "data" / "mocap", load_sensor("vlp32c")
    target = load_target(folder / "target.yaml")
    return tuple((read_scan(path, sensor), target) for path in sorted(folder.glob("session*/*.pcd")))


def errors(estimate: PoseEstimate, T_lidar_target: np.ndarray) -> tuple[float, float]:
    """RMSE over the vertices, metres, and rotation error, degrees."""
    truth = estimate.target.vertices @ T_lidar_target[:3, :3].T + T_lidar_target[:3, 3]
    rmse = float(np.sqrt(np.mean(np.sum((estimate.vertices - truth) ** 2, axis=1))))
    turn = gtsam.Rot3.Logmap(gtsam.Rot3(T_lidar_target[:3, :3].T @ estimate.T_lidar_target[:3, :3]))
    return rmse, float(np.degrees(np.linalg.norm(turn)))


def simulated(
    distance: float,
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int = 0,
    target: Target | str = "paper",
    sensor: SensorModel | str = "vlp32c",
    noise: NoiseModel | None = None,
) -> tuple[Scan, np.ndarray]:
    """A scan of a target, its true pose jittered by more than an azimuth step and a ring gap; and that pose."""
    target = load_target(target) if isinstance(target, str) else target
    sensor = load_sensor(sensor) if isinstance(sensor, str) else sensor
    rng = np.random.default_rng(seed)
    position = [distance + rng.uniform(-0.5, 0.5), *rng.uniform(-0.3, 0.3, 2)]
    T = pose_from_rpy(position, np.radians(rpy_deg) + rng.normal(0.0, 0.05, 3))
    return simulate_target(target, sensor, T, noise=noise or NoiseModel.of(sensor), rng=rng), T
