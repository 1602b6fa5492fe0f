"""A sensor that moves while it scans: poses as a function of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError


class Motion(Protocol):
    """Poses of the LiDAR in the world."""

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """Return T_world_lidar at (N,) times, seconds: (N, 3, 3) rotations and (N, 3) translations."""


@dataclass(frozen=True, eq=False, repr=False)
class ConstantTwist(Value):
    """T_world_lidar(t) = T_world_lidar Exp(t twist): constant velocity in the body frame.

    Attributes:
        T_world_lidar: (4, 4) at time 0.
        twist: (6,) angular velocity, rad/s, then velocity, m/s, LiDAR frame.
    """

    T_world_lidar: Floats
    twist: Floats

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """See `Motion.at`."""
        increments = RigidTransform.from_exp_coords(np.multiply.outer(times, np.asarray(self.twist, dtype=float)))
        poses = RigidTransform.from_matrix(self.T_world_lidar) * increments
        return poses.rotation.as_matrix(), poses.translation


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Value):
    """Poses at given times; between two of them, constant velocity in the world and constant angular velocity.

    Attributes:
        times: (K,) seconds, increasing.
        T_world_lidar: (K, 4, 4).

    Raises:
        InputError: fewer than two poses, or times that do not increase.
    """

    times: Floats
    T_world_lidar: Floats

    def __post_init__(self) -> None:
        times, poses = frozen(self.times), frozen(self.T_world_lidar)
        if times.ndim != 1 or len(times) < 2 or poses.shape != (len(times), 4, 4) or (np.diff(times) <= 0).any():
            raise InputError(
                f"trajectory: expected K >= 2 increasing times and (K, 4, 4) poses, found shapes {times.shape}, "
                f"{poses.shape}"
            )
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "T_world_lidar", poses)

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """See `Motion.at`.

        Raises:
            InputError: times outside those of the poses.
        """
        if times.min() < self.times[0] or times.max() > self.times[-1]:
            raise InputError(
                f"trajectory: covers {self.times[0]:g} to {self.times[-1]:g} s; "
                f"asked for {times.min():g} to {times.max():g} s"
            )
        rotations = Slerp(self.times, Rotation.from_matrix(self.T_world_lidar[:, :3, :3]))(times)
        translations = [np.interp(times, self.times, self.T_world_lidar[:, k, 3]) for k in range(3)]
        return rotations.as_matrix(), np.column_stack(translations)
