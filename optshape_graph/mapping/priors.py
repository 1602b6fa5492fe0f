"""What is known of landmarks before: surveyed one by one, or a map with its joint covariance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, frozen
from optshape_graph.errors import InputError
from optshape_graph.factors._rows import gaussian


def joint_prior(keys: Sequence[int], poses: Sequence[Floats], covariance: Floats) -> list[gtsam.NonlinearFactor]:
    """Return the factors of a joint Gaussian prior of poses.

    Independent poses take a prior each. Otherwise it is one factor, linear in the poses' local coordinates.

    Args:
        keys: (m,) of the poses.
        poses: (m,) of (4, 4) means.
        covariance: (6 m, 6 m) of their right perturbations, rotation first, in the order of the keys.
    """
    m = len(keys)
    blocks = covariance.reshape(m, 6, m, 6).swapaxes(1, 2)
    off_diagonal = blocks[~np.eye(m, dtype=bool)]
    if not off_diagonal.size or np.abs(off_diagonal).max() == 0.0:
        return [
            gtsam.PriorFactorPose3(key, gtsam.Pose3(T), gaussian(sqrt_information(blocks[k, k])))
            for k, (key, T) in enumerate(zip(keys, poses, strict=True))
        ]
    R = sqrt_information(covariance)
    information = (R.T @ R).reshape(m, 6, m, 6).swapaxes(1, 2)
    # Pairs of variables are what GTSAM's Hessian takes from Python; added up they are one factor of all of them.
    quadratic, zero = gtsam.GaussianFactorGraph(), np.zeros(6)
    for i in range(m):
        quadratic.push_back(gtsam.HessianFactor(keys[i], information[i, i], zero, 0.0))
        for j in range(i + 1, m):
            nothing = np.zeros((6, 6))
            pair = gtsam.HessianFactor(keys[i], keys[j], nothing, information[i, j], zero, nothing, zero, 0.0)
            quadratic.push_back(pair)
    means = gtsam.Values()
    for key, T in zip(keys, poses, strict=True):
        means.insert(key, gtsam.Pose3(T))
    return [gtsam.LinearContainerFactor(gtsam.HessianFactor(quadratic), means)]


def sqrt_information(covariance: Floats) -> Floats:
    """Return R (d, d), upper triangular, with R^T R the inverse of a covariance matrix (d, d).

    Raises:
        numpy.linalg.LinAlgError: the covariance is not positive definite.
    """
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T)


def root_of(covariance: Floats, what: str) -> Floats:
    """Return the square root information (6, 6) of a pose's covariance.

    Raises:
        InputError: the covariance is not 6 x 6, finite and positive definite.
    """
    C = np.asarray(covariance, float)
    if C.shape == (6, 6):
        with suppress(np.linalg.LinAlgError):
            root = _root(C.tobytes())
            if math.isfinite(np.vdot(root, root)):
                return root
    raise InputError(f"{what} covariance: expected 6 x 6, positive definite; found shape {C.shape}: {C.tolist()}")


@lru_cache(maxsize=1)
def _root(covariance: bytes) -> Floats:
    """Square root information of a (6, 6) covariance; odometry often has the same one again and again."""
    return frozen(sqrt_information(np.frombuffer(covariance).reshape(6, 6)))
