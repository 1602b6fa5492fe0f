"""KITTI trajectories: a line for each pose, and a file of stamps beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph.errors import InputError
from optshape_graph.io.files import write_atomically
from optshape_graph.io.trajectories.numbers import NORM_TOLERANCE, rows_of, text_of
from optshape_graph.io.trajectories.trajectory import Trajectory


def read_kitti(path: str | Path, times: str | Path | None = None) -> Trajectory:
    """Read a KITTI trajectory: each line has the first three rows of T_world_body, each line of `times` a stamp.

    Raises:
        InputError: a line of other numbers, a matrix that is not a rotation, or other than one stamp for each pose.
    """
    path = Path(path)
    rows = list(rows_of(path, 12))
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = np.array([row for _, row in rows]).reshape(-1, 3, 4)
    for (where, _), R in zip(rows, T[:, :3, :3], strict=True):
        if np.abs(R.T @ R - np.eye(3)).max() > NORM_TOLERANCE or np.linalg.det(R) < 0:
            raise InputError(f"{where}: its 3 x 3 part is not a rotation")
    if len(T):
        T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
    stamps = None if times is None else np.array([row[0] for _, row in rows_of(Path(times), 1)])
    if stamps is not None and len(stamps) != len(T):
        raise InputError(f"{times}: {len(stamps)} stamps for the {len(T)} poses of {path}")
    return Trajectory(T, stamps, str(path))


def write_kitti(path: str | Path, trajectory: Trajectory, times: str | Path | None = None) -> None:
    """Write a KITTI trajectory, and its stamps to `times` if given.

    Raises:
        InputError: `times` is given and the trajectory has no stamps.
    """
    if times is not None and trajectory.stamps is None:
        raise InputError(f"{trajectory.name}: it has no stamps to write to {times}")
    write_atomically(Path(path), "".join(f"{text_of(T[:3].ravel())}\n" for T in trajectory.poses))
    if times is not None and trajectory.stamps is not None:
        write_atomically(Path(times), "".join(f"{stamp:.9f}\n" for stamp in trajectory.stamps))
