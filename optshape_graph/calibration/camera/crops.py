"""Returns of a target out of a crop made by hand, which holds others too."""

from __future__ import annotations

import numpy as np

from optshape_graph.errors import EstimationError
from optshape_graph.scan import Scan

TOLERANCE_M = 0.04
"""Distance from the plane within which a return is the target's: three standard deviations of a range and a bias."""

TRIALS = 300


def planar_returns(scan: Scan) -> Scan:
    """Return the returns near the plane that most of them share (RANSAC, then least squares; the same every time).

    Raises:
        EstimationError: fewer than half of the returns, or fewer than four, lie near any plane.
    """
    points = scan.points
    if len(points) < 4:
        raise EstimationError(f"{scan.name}: {len(points)} returns do not make a target")
    rng = np.random.default_rng(0)
    corners = points[rng.integers(len(points), size=(TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sizes = np.linalg.norm(normals, axis=1)
    wide = sizes > 1e-6
    normals, origins = normals[wide] / sizes[wide, None], corners[wide, 0]
    distances = np.abs(points @ normals.T - np.einsum("ti,ti->t", normals, origins))
    near = (
        distances[:, (distances < TOLERANCE_M).sum(axis=0).argmax()] < TOLERANCE_M if wide.any() else np.zeros(0, bool)
    )
    for _ in range(3):
        if near.sum() < max(4, len(points) / 2):
            raise EstimationError(f"{scan.name}: {int(near.sum())} of {len(points)} returns lie near one plane")
        centre = points[near].mean(axis=0)
        normal = np.linalg.svd(points[near] - centre, full_matrices=False)[2][2]
        near = np.abs((points - centre) @ normal) < TOLERANCE_M
    return scan.select(near)
