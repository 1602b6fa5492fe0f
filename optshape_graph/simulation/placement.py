"""Poses from angles and distances, as simulations state them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError


def pose_from_rpy(position: ArrayLike, rpy: ArrayLike = (0.0, 0.0, 0.0)) -> Floats:
    """Return the pose (4, 4) with R = Rx(roll) Ry(pitch) Rz(yaw).

    Args:
        position: (3,) metres.
        rpy: (3,) roll, pitch, yaw, rad.

    Raises:
        InputError: not three finite numbers each.
    """
    position, angles = np.asarray(position, dtype=float), np.asarray(rpy, dtype=float)
    if (
        position.shape != (3,)
        or angles.shape != (3,)
        or not (np.isfinite(position).all() and np.isfinite(angles).all())
    ):
        raise InputError(f"expected a position and roll, pitch, yaw of three numbers each, found {position}, {angles}")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("XYZ", angles).as_matrix()
    T[:3, 3] = position
    return T
