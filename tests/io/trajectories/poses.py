"""Poses to write and read again."""

import numpy as np
from scipy.spatial.transform import Rotation


def poses(n: int, seed: int = 0) -> np.ndarray:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.random(n, rng=seed).as_matrix()
    T[:, :3, 3] = np.random.default_rng(seed).normal(0, 100, (n, 3))
    return T
