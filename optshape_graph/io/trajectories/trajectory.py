"""Poses over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Value):
    """Poses over time.

    Attributes:
        poses: (N, 4, 4) T_world_body.
        stamps: (N,) seconds, increasing; None: the format has none.
        name: where it came from, for messages.

    Raises:
        InputError: shapes that do not fit, values that are not finite, stamps that do not increase.
    """

    poses: Floats
    stamps: Floats | None = None
    name: str = "trajectory"

    def __post_init__(self) -> None:
        poses = frozen(self.poses)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not np.isfinite(poses).all():
            raise InputError(f"{self.name}: expected finite poses as N x 4 x 4, found shape {poses.shape}")
        object.__setattr__(self, "poses", poses)
        if self.stamps is None:
            return
        stamps = frozen(self.stamps)
        if stamps.shape != (len(poses),) or not np.isfinite(stamps).all():
            raise InputError(f"{self.name}: {len(poses)} poses but stamps of shape {stamps.shape}, or not finite")
        if (np.diff(stamps) <= 0).any():
            k = int((np.diff(stamps) <= 0).argmax())
            raise InputError(f"{self.name}: stamp {stamps[k + 1]:.9f} of pose {k + 1} does not exceed {stamps[k]:.9f}")
        object.__setattr__(self, "stamps", stamps)

    def __len__(self) -> int:
        return len(self.poses)
