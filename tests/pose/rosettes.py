"""Clouds of a scanner without rings: two turning prisms draw a rosette, as Livox's do."""

import numpy as np

from optshape_graph import Scan, Target
from optshape_graph.simulation import pose_from_rpy


def rosette(
    target: Target, distance: float, shots: int, seed: int, *, beam: float = 3e-3, aperture: float = 0.01
) -> tuple[Scan, np.ndarray]:
    """Returns of a target, a beam's edges cut anywhere within its width, and the true T_lidar_target.

    Range noise and range bias are a centimetre each, as an unknown sensor's are taken to be.
    """
    rng = np.random.default_rng(seed)
    T = pose_from_rpy([distance, *rng.uniform(-0.3, 0.3, 2)], rng.uniform(-0.5, 0.5, 3))
    k, phase, radius = np.arange(shots), rng.uniform(0, 2 * np.pi), np.radians(9.5)
    fast, slow = 0.0446 * k + phase, -0.02117 * k + 1.7 * phase
    u, v = radius * (np.cos(fast) + np.cos(slow)), radius * (np.sin(fast) + np.sin(slow))
    rays = np.column_stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)])
    normal, centre = T[:3, 0], T[:3, 3]
    ranges = (normal @ centre) / (rays @ normal)
    outside = target.outside_distance((rays * ranges[:, None] - centre) @ T[:3, 1:3])
    width = aperture + beam * ranges
    hit = outside < width * (rng.uniform(-0.5, 0.5, shots) + rng.uniform(-0.5, 0.5, shots))
    measured = ranges[hit] + rng.normal(0.0, 0.01, int(hit.sum())) + rng.normal(0.0, 0.01)
    return Scan(rays[hit] * measured[:, None], name=f"rosette {seed}"), T
