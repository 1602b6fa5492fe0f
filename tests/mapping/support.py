"""A robot that drives past targets: true poses, noisy odometry, and measurements with noise that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph import Target
from optshape_graph.mapping.track import Sighting
from optshape_graph.se3 import inverse
from tests.factors.support import TARGET, measure, retract


def at(x: float, y: float, heading: float, z: float = 0.0) -> np.ndarray:
    """Return the pose (4, 4) at a place, turned about z, rad."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    T[:3, 3] = [x, y, z]
    return T


@dataclass(frozen=True, eq=False)
class World:
    """A closed path, and targets beside it.

    Attributes:
        poses: (N, 4, 4) true T_world_lidar; the first is the world's origin.
        targets: (M, 4, 4) true T_world_target.
        motion_sigma: (6,) standard deviation of the odometry between two poses.
    """

    poses: np.ndarray
    targets: np.ndarray
    motion_sigma: np.ndarray

    def odometry(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Return noisy T_i_(i+1)."""
        return [
            retract(inverse(a) @ b, self.motion_sigma * rng.normal(size=6))
            for a, b in zip(self.poses[:-1], self.poses[1:], strict=True)
        ]

    def near(self, i: int, reach: float, most: int | None = None) -> list[int]:
        """Return the targets within reach of pose i, the nearest first."""
        distance = np.linalg.norm(self.targets[:, :3, 3] - self.poses[i, :3, 3], axis=1)
        return [int(j) for j in np.argsort(distance)[:most] if distance[j] < reach]

    def sighting(
        self, rng: np.random.Generator, i: int, j: int, landmark: str | None, template: Target = TARGET
    ) -> Sighting:
        """Return what pose i sees of target j; its measurement was taken near the truth, not at it."""
        H = inverse(self.targets[j]) @ self.poses[i]
        measurement = measure(rng, H, target=template)
        return Sighting(template, (measurement.at(retract(H, 0.01 * rng.normal(size=6))),), landmark)


def loop(
    length: float = 500.0,
    n_poses: int = 500,
    n_targets: int = 12,
    laps: int = 1,
    sigma_m: float = 0.01,
    sigma_deg: float = 0.1,
    beside: float = 4.0,
) -> World:
    """Return a circular path of a length per lap, noise of the odometry growing with the square root of the distance.

    Args:
        length: metres of a lap.
        n_poses: poses of a lap.
        n_targets: spread evenly around it.
        laps: number of laps.
        sigma_m: standard deviation of the odometry's translation per square root of a metre, each axis, metres.
        sigma_deg: standard deviation of its rotation, likewise, deg.
        beside: how far outside the path the targets stand, metres.
    """
    radius = length / (2 * np.pi)
    angle = 2 * np.pi * np.arange(n_poses * laps) / n_poses
    path = np.array([at(radius * np.sin(a), radius * (1 - np.cos(a)), a) for a in angle])
    targets = []
    for a in 2 * np.pi * (np.arange(n_targets) + 0.3) / n_targets:
        r = radius + beside
        targets.append(at(r * np.sin(a), radius - r * np.cos(a), a - np.pi / 2 + 0.4, 0.3))
    step = np.sqrt(length / n_poses)
    sigma = step * np.array([np.radians(sigma_deg)] * 3 + [sigma_m] * 3)
    return World(path, np.array(targets), sigma)


def covariance(sigma: Sequence[float] | np.ndarray) -> np.ndarray:
    return np.diag(np.square(sigma))
