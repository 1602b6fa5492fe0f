"""Pixel coordinates of a target's points from a CSV file, for corners that something else has found."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.errors import InputError
from optshape_graph.io.clouds.text import read_table
from optshape_graph.target import Target

CORNER_SIGMA_PX = 0.5
"""Standard deviation of a coordinate where the file has no column `sigma`."""


def read_pixel_table(path: Path, target: Target) -> ImagePoints:
    """Read the pixels of a target's vertices, or of any points of its plane.

    The first line names the columns: `vertex,u,v` (the vertex's number, from 0) or `y,z,u,v` (metres, target frame),
    and `sigma` (pixels) if wanted.

    Args:
        path: the CSV file.
        target: whose points they are.

    Raises:
        InputError: other columns, a value that is no finite number, or a vertex that the target lacks.
    """
    known = ("vertex", "y", "z", "u", "v", "sigma")
    table = read_table(path, lambda names: [name for name in names if name.lower() in known], "vertex,u,v")
    columns = {name.lower(): np.asarray(values, float) for name, values in table.values.items()}
    for name, values in columns.items():
        if not np.isfinite(values).all():
            raise InputError(f"{path}: {int((~np.isfinite(values)).sum())} values of '{name}' are not finite")
    if set(columns) - {"sigma"} == {"vertex", "u", "v"}:
        unknown = [v for v in columns["vertex"] if v not in range(len(target))]
        if unknown:
            raise InputError(f"{path}: vertex {unknown[0]:g}; target '{target.name}' has 0 to {len(target) - 1}")
        points = target.vertices[columns["vertex"].astype(int)]
    elif set(columns) - {"sigma"} == {"y", "z", "u", "v"}:
        points = np.column_stack([np.zeros(len(columns["y"])), columns["y"], columns["z"]])
    else:
        raise InputError(f"{path}: columns {', '.join(columns)}; expected vertex,u,v or y,z,u,v, and sigma if wanted")
    sigma = columns.get("sigma", np.full(len(points), CORNER_SIGMA_PX))
    if (sigma <= 0).any():
        raise InputError(f"{path}: sigma {sigma.min():g} px; expected positive numbers")
    return ImagePoints(points, np.column_stack([columns["u"], columns["v"]]), np.eye(2) / sigma[:, None, None])
