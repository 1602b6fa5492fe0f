"""Rigid transforms as 4 x 4 arrays: the few formulas the factors need, over any leading batch dimensions.

Tangent vectors are GTSAM's: [rotation; translation], a perturbation on the right, T Exp(xi).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats


def skew(v: Floats) -> Floats:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3), in their unit."""
    S = np.zeros((*v.shape[:-1], 3, 3))
    S[..., 0, 1], S[..., 0, 2], S[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    S[..., 1, 0], S[..., 2, 0], S[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return S


def inverse(T: Floats) -> Floats:
    """Return the inverse of rigid transforms (..., 4, 4)."""
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3] = R_transposed
    result[..., :3, 3] = -(R_transposed @ T[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def vec(T: Floats) -> Floats:
    """Return z = [vec R (column-major); t] (..., 12) of transforms (..., 4, 4)."""
    return np.reshape(np.swapaxes(T[..., :3, :], -1, -2), (*T.shape[:-2], 12))


def vec_derivative(T: Floats) -> Floats:
    """Return the derivative (..., 12, 6) of z by a right perturbation: column j of R [w]x is -R [e_j]x w."""
    x, y, z = T[..., :3, 0], T[..., :3, 1], T[..., :3, 2]
    D = np.zeros((*T.shape[:-2], 12, 6))
    D[..., 0:3, 1], D[..., 0:3, 2] = -z, y  # R [e_x]x = [0, z, -y], and so on
    D[..., 3:6, 0], D[..., 3:6, 2] = z, -x
    D[..., 6:9, 0], D[..., 6:9, 1] = -y, x
    D[..., 9:, 3:] = T[..., :3, :3]
    return D


def adjoint(T: Floats) -> Floats:
    """Return Ad(T) (..., 6, 6): T Exp(xi) = Exp(Ad(T) xi) T, rotation first."""
    R = T[..., :3, :3]
    Ad = np.zeros((*T.shape[:-2], 6, 6))
    Ad[..., :3, :3] = Ad[..., 3:, 3:] = R
    Ad[..., 3:, :3] = skew(T[..., :3, 3]) @ R
    return Ad


def inverse_covariance(T_a_b: ArrayLike, covariance: ArrayLike) -> Floats:
    """Return the covariance of T_b_a from that of T_a_b.

    (T Exp(xi))^-1 = T^-1 Exp(-Ad(T) xi), so the covariance goes through the Adjoint of T_a_b.

    Args:
        T_a_b: (..., 4, 4) rigid transform.
        covariance: (..., 6, 6) of the right perturbation of T_a_b, rotation first.

    Returns:
        (..., 6, 6) of the right perturbation of T_b_a, rotation first.
    """
    Ad = adjoint(np.asarray(T_a_b, float))
    return np.asarray(Ad @ np.asarray(covariance, float) @ np.swapaxes(Ad, -1, -2))
