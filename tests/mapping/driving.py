"""A robot that drives a path past targets: scans simulated while it moves, by a LiDAR that keeps its biases."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from optshape_graph import EstimationError, Target
from optshape_graph.io import load_sensor, load_target
from optshape_graph.mapping import LandmarkSlam, Sighting
from optshape_graph.mapping.motion import deskew, twist_between
from optshape_graph.pose import estimate_pose
from optshape_graph.se3 import inverse, skew
from optshape_graph.simulation import NoiseModel, Patch, Scene, simulate
from tests.factors.support import retract
from tests.mapping.support import covariance

SENSOR, PAPER = load_sensor("vlp32c"), load_target("paper")

FEWEST = 20
"""Returns on a target, below which it is not looked at."""


@dataclass(frozen=True, eq=False)
class Twisting:
    """A constant twist from a pose, as `simulation.ConstantTwist`, by Rodrigues' formula: ten times as fast.

    Attributes:
        T_world_lidar: (4, 4) at time 0.
        twist: (6,) rotation first, rad/s and m/s, LiDAR frame.
    """

    T_world_lidar: np.ndarray
    twist: np.ndarray

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations (N, 3, 3) and positions (N, 3)."""
        R0, v, rate = self.T_world_lidar[:3, :3], self.twist[3:], max(float(np.linalg.norm(self.twist[:3])), 1e-9)
        K = skew(self.twist[:3] / rate)
        sine, versine = np.sin(rate * times)[:, None], 2.0 * np.sin(0.5 * rate * times)[:, None] ** 2
        R = (R0.ravel() + sine * (R0 @ K).ravel() + versine * (R0 @ K @ K).ravel()).reshape(-1, 3, 3)
        along = times[:, None] * (v + K @ K @ v) - sine * (K @ K @ v) / rate + versine * (K @ v) / rate
        return R, self.T_world_lidar[:3, 3] + along @ R0.T


@dataclass(frozen=True, eq=False)
class Drive:
    """What a robot measured.

    Attributes:
        poses: (N, 4, 4) true T_world_lidar, a second apart.
        targets: (M, 4, 4) true T_world_target.
        odometry: (N - 1, 4, 4) between the poses, with noise, and
        covariances: (N - 1, 6, 6) of it.
        sightings: at each pose, of the targets named `t0`, `t1`, ...
    """

    poses: np.ndarray
    targets: np.ndarray
    odometry: np.ndarray
    covariances: np.ndarray
    sightings: list[list[Sighting]]

    def feed(self, slam: LandmarkSlam) -> LandmarkSlam:
        """Give all of it to landmark SLAM."""
        for i, sightings in enumerate(self.sightings):
            slam.add_odometry(float(i), *((self.odometry[i - 1], self.covariances[i - 1]) if i else ()))
            slam.add_measurements(sightings)
        slam.settle()
        return slam

    def dead_reckoning(self) -> np.ndarray:
        """Return the poses (N, 4, 4) that odometry alone gives, from the true first one."""
        poses = [self.poses[0]]
        for T in self.odometry:
            poses.append(poses[-1] @ T)
        return np.array(poses)


def drive(
    poses: np.ndarray,
    targets: np.ndarray,
    seed: int,
    *,
    reach: float = 20.0,
    sigma_m: float = 0.01,
    sigma_deg: float = 0.1,
    target: Target = PAPER,
) -> Drive:
    """Drive a path past targets at one pose a second, and measure each target within reach that is seen from its front.

    Scans are deskewed by the odometry's twist, and targets estimated from the returns on them.

    Args:
        poses: (N, 4, 4) true T_world_lidar.
        targets: (M, 4, 4) true T_world_target.
        seed: of all noise.
        reach: metres.
        sigma_m: odometry's noise per square root of a metre, each axis, metres.
        sigma_deg: likewise, deg.
        target: the template of all targets.
    """
    rng = np.random.default_rng([7, seed])
    noise = NoiseModel.of(SENSOR)
    bias, angles = noise.draw_range_bias(SENSOR.n_rings, rng), noise.draw_angle_errors(SENSOR.n_rings, rng)
    true = inverse(poses[:-1]) @ poses[1:]
    gone = np.linalg.norm(true[:, :3, 3], axis=1)
    sigma = np.sqrt(gone)[:, None] * np.array([np.radians(sigma_deg)] * 3 + [sigma_m] * 3)
    measured = np.array([retract(T, s * rng.normal(size=6)) for T, s in zip(true, sigma, strict=True)])
    sightings = []
    for i, T in enumerate(poses):
        k = min(i, len(true) - 1)
        motion, twist = Twisting(T, twist_between(true[k], 1.0)), twist_between(measured[k], 1.0)
        near = [j for j, X in enumerate(targets) if _in_view(X, T, reach)]
        seen = []
        if near:
            scene = Scene(tuple(Patch(target, targets[j]) for j in near))
            simulated = simulate(scene, SENSOR, motion, noise=noise, rng=rng, range_bias=bias, angle_errors=angles)
            for n, j in enumerate(near):
                returns = simulated.target_returns(n)
                if len(returns) < FEWEST:
                    continue
                try:
                    estimate = estimate_pose(deskew(returns, twist), target)
                except EstimationError:
                    continue
                if estimate.usable:
                    seen.append(Sighting.of(estimate, f"t{j}"))
        sightings.append(seen)
    return Drive(poses, targets, measured, np.array([covariance(s) for s in sigma]), sightings)


def _in_view(T_world_target: np.ndarray, T_world_lidar: np.ndarray, reach: float) -> bool:
    seen = inverse(T_world_target) @ T_world_lidar[:, 3]
    return bool(np.linalg.norm(seen[:3]) < reach and seen[0] < -1.0)


def kitti_path() -> np.ndarray:
    """Return the camera poses of KITTI's sequence 00 that GTSAM ships, as (N, 4, 4) of a LiDAR: x ahead, z up.

    110 m of driving in town with a turn, 0.8 m between poses, surveyed by inertial and satellite navigation.
    """
    rows = np.loadtxt(gtsam.findExampleDataFile("VO_camera_poses00.txt"))
    T_camera_lidar = np.eye(4)
    T_camera_lidar[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    poses = rows[:, 1:].reshape(-1, 4, 4).copy()
    poses[:, :3, :3] = [gtsam.Rot3.ClosestTo(R).matrix() for R in poses[:, :3, :3]]
    poses = poses @ T_camera_lidar
    return np.asarray(inverse(poses[0]) @ poses)


def beside(poses: np.ndarray, every: int, distance: float = 5.0) -> np.ndarray:
    """Return targets (M, 4, 4) on both sides of a path in turn, upright, turned towards who comes."""
    found = []
    for n, k in enumerate(range(every // 2, len(poses), every)):
        side = 1.0 if n % 2 else -1.0
        heading = np.arctan2(poses[k, 1, 0], poses[k, 0, 0]) + side * 0.7
        place = poses[k] @ np.array([0.0, side * distance, 0.2, 1.0])
        T = np.eye(4)
        T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        T[:3, 3] = place[:3]
        found.append(T)
    return np.array(found)
