"""Trajectory files: which form a file has, and the rigid bodies of motion capture as trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.clouds.text import decode
from optshape_graph.io.files import is_file, read_bytes
from optshape_graph.io.mocap import form_of, read_motive_bodies
from optshape_graph.io.trajectories.g2o import is_g2o
from optshape_graph.io.trajectories.numbers import poses_of
from optshape_graph.io.trajectories.trajectory import Trajectory
from optshape_graph.io.trajectories.tum import read_lines


def is_trajectory(name: str | Path) -> bool:
    """Return whether `read_trajectory` takes a name: one that ends in `.tum`, or a FILE or FILE:BODY that is there."""
    path = Path(name)
    return path.suffix == ".tum" or is_file(path) or _file_and_body(path) is not None


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory with stamps, whatever the file's ending.

    - TUM: lines of `stamp tx ty tz qx qy qz qw`, separated by blanks or commas, `#` for comments.
    - The same with a line, a comment or not, that names the columns: their order and units are taken from it, as in
      EuRoC's and TUM-VI's CSV (nanoseconds, w first). Other columns are passed over.
    - A rigid body of an export of OptiTrack Motive; FILE:BODY names one of several.

    Stamps in milli-, micro- or nanoseconds since 1970 are recognised by their size. Lines that are not poses, and poses
    whose stamp is not after the one before, are left out; a warning counts them. They may be few only
    (`tum.LARGEST_BAD_SHARE`).

    Raises:
        InputError: not readable, poses without stamps (KITTI, g2o) or without quaternions, a quaternion whose order
            nothing tells, or too many lines that are not poses.
    """
    path = Path(path)
    if not is_file(path) and (named := _file_and_body(path)):
        return read_rigid_body(*named)
    text = decode(read_bytes(path))
    if is_g2o(text):
        raise InputError(f"{path}: a pose graph (g2o), whose poses have no stamps; expected a trajectory with them")
    if form_of(text) == "motive":
        return read_rigid_body(path)
    return read_lines(path, text)


def read_rigid_body(path: str | Path, body: str | None = None) -> Trajectory:
    """Read the poses T_mocap_body of a rigid body in a CSV export of OptiTrack Motive; stamps since the capture began.

    Frames in which the body was not seen are left out.

    Args:
        path: the file.
        body: its name; None: the only one.

    Raises:
        InputError: no such body, several bodies but no name, or rotations that are not quaternions.
    """
    times, bodies = read_motive_bodies(Path(path))
    if body is None and len(bodies) == 1:
        (body,) = bodies
    if body is None or body not in bodies:
        asked = f"no rigid body '{body}'; " if body is not None else ""
        raise InputError(f"{path}: {asked}it has {', '.join(bodies) or 'none'}: name one, as {Path(path).name}:NAME")
    values = bodies[body]
    seen = np.isfinite(values).all(axis=1)
    places = [f"{path}, frame {k}" for k in np.flatnonzero(seen)]
    return Trajectory(poses_of(values[seen, :3], values[seen, 3:], places), times[seen], str(path))


def _file_and_body(path: Path) -> tuple[Path, str] | None:
    """Return the two parts of FILE:BODY; None: there is no such file."""
    file, colon, body = path.name.rpartition(":")
    return (path.parent / file, body) if colon and is_file(path.parent / file) else None
