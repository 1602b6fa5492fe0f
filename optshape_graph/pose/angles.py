"""Angular noise: seen in the elevations, which should not vary within a ring, and taken out of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints
from optshape_graph.scan import Scan

NEGLIGIBLE = 1e-4
"""Scatter of elevations within a ring, rad, below which angles count as exact: that of real sensors, to rounding."""


def level_rings(scan: Scan) -> tuple[Scan, float]:
    """Put every return back on the cone of its ring, and say how far the returns were off it.

    A ring's elevation is the sensor's, where its returns agree with it, else their mean. An angular noise is taken
    to be alike in azimuth, where it cannot be taken out.

    Args:
        scan: the returns of one target, with rings.

    Returns:
        The scan, unchanged where its angles are exact; and the standard deviation of an angle, rad.
    """
    if scan.ring is None or len(scan) == 0:
        return scan, 0.0
    flat = np.hypot(scan.points[:, 0], scan.points[:, 1])
    elevation = np.arctan2(scan.points[:, 2], flat)
    rings, inverse, counts = np.unique(scan.ring, return_inverse=True, return_counts=True)
    mean = np.bincount(inverse, elevation) / counts
    off = elevation - mean[inverse]
    freedom = len(scan) - len(rings)
    noise = float(np.sqrt((off**2).sum() / freedom)) if freedom > 0 else 0.0
    if noise < NEGLIGIBLE:
        return scan, 0.0
    level, known = _known(scan, rings, mean, noise / np.sqrt(counts))
    level = level[inverse]
    # A known elevation is no unknown: far away, where rings have few returns, that is half of what there is.
    noise = float(np.sqrt(((elevation - level) ** 2).sum() / (len(scan) - (~known).sum())))
    ranges = np.linalg.norm(scan.points, axis=1)
    horizontal = scan.points[:, :2] / np.maximum(flat, 1e-12)[:, None]
    points = np.column_stack([horizontal * np.cos(level)[:, None], np.sin(level)]) * ranges[:, None]
    return replace(scan, points=points), noise


def _known(scan: Scan, rings: Ints, mean: Floats, error: Floats) -> tuple[Floats, Bools]:
    """Elevation of each ring: the sensor's table where the mean agrees with it, within 5 standard errors; and where."""
    if scan.sensor is None or rings.max() >= scan.sensor.n_rings:
        return mean, np.zeros(len(rings), dtype=bool)
    table = scan.sensor.elevations[rings]
    known = np.abs(mean - table) < 5 * error
    return np.where(known, table, mean), known
