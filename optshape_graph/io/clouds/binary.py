"""Clouds without a header: 32-bit floats, as KITTI and nuScenes publish them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.clouds.columns import Columns
from optshape_graph.io.files import read_bytes

KITTI = ("x", "y", "z", "intensity")
"""Values of a return in KITTI's `.bin`: metres, LiDAR frame; in the order of firing, beam by beam, the uppermost first
(Geiger et al., Vision meets Robotics: The KITTI Dataset, IJRR 2013, and its development kit)."""

NUSCENES = (*KITTI, "ring")
"""Values of a return in nuScenes' `.pcd.bin`: metres, LiDAR frame, the ring counted from the lowest beam
(nuscenes-devkit, LidarPointCloud.from_file)."""

FARTHEST_M = 1e4
"""A LiDAR measures no coordinates beyond this, metres; larger numbers show that the layout is another."""


def read_binary(path: str | Path, names: tuple[str, ...] | None = None) -> Columns:
    """Return the columns of a file that consists of little-endian 32-bit floats.

    A return has five values if the fifth is always an integer from 0 to 255, or the ending is `.pcd.bin`; else four.

    Args:
        path: the file.
        names: of the values of a return, in order; None: those of KITTI or nuScenes.

    Raises:
        InputError: not readable, a return that is cut off, or numbers that no LiDAR measures.
    """
    data = read_bytes(path)
    if len(data) % 4 or not data:
        raise InputError(
            f"{path}: {len(data)} bytes; expected 32-bit floats, four of a return (KITTI) or five (nuScenes)"
        )
    values = np.frombuffer(data, "<f4")
    layouts = (
        [names] if names is not None else [NUSCENES] if str(path).lower().endswith(".pcd.bin") else [NUSCENES, KITTI]
    )
    for layout in layouts:
        if len(values) % len(layout):
            continue
        table = values.reshape(-1, len(layout))
        columns = {name: table[:, k] for k, name in enumerate(layout) if name not in ("", "_", "-")}
        if names is not None or _plausible(columns):
            return Columns(columns, name=str(path), fired="ring" not in columns)
    count = " or ".join(str(len(layout)) for layout in layouts)
    raise InputError(
        f"{path}: {len(data)} bytes are not {count} 32-bit floats a return, as KITTI's and nuScenes' files have; "
        "name the values of a file of another layout: --columns x,y,z,intensity,_,ring"
    )


@np.errstate(invalid="ignore", over="ignore")
def _plausible(columns: dict[str, np.ndarray]) -> bool:
    xyz = np.column_stack([columns[axis] for axis in "xyz"])
    finite = np.isfinite(xyz).all(axis=1)
    if finite.mean() < 0.5 or (np.abs(xyz[finite]) > FARTHEST_M).any():
        return False
    ring = columns.get("ring")
    return ring is None or bool(((ring >= 0) & (ring < 256) & (ring % 1 == 0)).all())
