"""Rigid transforms as 4 x 4 arrays, in closed form, over any leading batch dimensions.

`T_a_b` maps points of frame b into frame a. Tangent vectors are GTSAM's: rotation (rad) first, then translation
(metres), a perturbation on the right, T Exp(xi). Formulas: Barfoot, State Estimation for Robotics, 2017, chapter 7.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import factorial
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats, frozen
from optshape_graph.compiled import address, library
from optshape_graph.errors import InputError

RIGID = 1e-6
"""Largest entry of R^T R - I that a rigid transform may have; a text file with seven digits stays below it."""

_SMALL_ANGLE = 1.0
"""Angle, rad, below which coefficients are summed as power series; above it their closed forms lose no digits."""

_TERMS = range(7, -1, -1)
"""Terms of those series; the remainder is below 1e-16 at the small angle."""

_THIRD = [(-1) ** k / factorial(2 * k + 3) for k in _TERMS]
_FOURTH = [(-1) ** k / factorial(2 * k + 4) for k in _TERMS]
_FIFTH = [(-1) ** k * (k + 1) / factorial(2 * k + 5) for k in _TERMS]

_UNIT = np.eye(3)


class Pose3(Protocol):
    """A pose that is not an array: `gtsam.Pose3`."""

    def matrix(self) -> Floats:
        """Return the transform (4, 4)."""


PoseLike: TypeAlias = ArrayLike | Pose3
"""A rigid transform as callers may give it: (4, 4), or a `gtsam.Pose3`."""


def as_matrix(T: PoseLike) -> Floats:
    """Return a transform as an array (..., 4, 4) without checking it, for calls made thousands of times a second."""
    return np.asarray(T.matrix() if hasattr(T, "matrix") else T, float)


def as_transform(T: PoseLike, what: str = "transform") -> Floats:
    """Return a rigid transform as a read-only (4, 4) array.

    Args:
        T: (4, 4), or a `gtsam.Pose3`.
        what: its name in the message.

    Raises:
        InputError: not a finite rigid transform.
    """
    try:
        pose = frozen(as_matrix(T))
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: expected a pose as 4 x 4 numbers, found {T!r}") from error
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise InputError(f"{what}: expected a finite pose as 4 x 4, found shape {pose.shape}")
    R = pose[:3, :3]
    x, y, z = R.T.tolist()
    handed = sum(x[i] * (y[i - 2] * z[i - 1] - y[i - 1] * z[i - 2]) for i in range(3))
    if np.abs(R.T @ R - _UNIT).max() > RIGID or handed < 0 or pose[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise InputError(f"{what}: not a rigid transform: {pose.tolist()}")
    return pose


def transform(R: ArrayLike, t: ArrayLike = (0.0, 0.0, 0.0)) -> Floats:
    """Return the transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3), metres."""
    rotation, translation = np.asarray(R, float), np.asarray(t, float)
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    T = np.zeros((*batch, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def apply(T: Floats, points: ArrayLike) -> Floats:
    """Return T p of points (..., N, 3), metres, row per point, under transforms (..., 4, 4)."""
    return np.asarray(np.asarray(points, float) @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3])


def inverse(T: Floats) -> Floats:
    """Return the inverse of transforms (..., 4, 4)."""
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3] = R_transposed
    result[..., :3, 3] = -(R_transposed @ T[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def skew(v: Floats) -> Floats:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3), in their unit."""
    S = np.zeros((*v.shape[:-1], 3, 3))
    S[..., 0, 1], S[..., 0, 2], S[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    S[..., 1, 0], S[..., 2, 0], S[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return S


def cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products (..., 3) of vectors (..., 3) in any units, faster than NumPy's."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


def rotation(w: ArrayLike) -> Floats:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3), rad: Rodrigues' formula."""
    vectors = np.asarray(w, float)
    W = skew(vectors)
    first, second = _first_two(np.sqrt(np.vecdot(vectors, vectors)))
    return np.asarray(_UNIT + first * W + second * (W @ W))


def rotation_vector(R: Floats) -> Floats:
    """Return the rotation vectors (..., 3), rad, at most pi long, of rotations (..., 3, 3).

    They are taken from unit quaternions (Shepperd, 1978), which keep all digits near 0 and near pi.
    """
    q = quaternion(R)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    return np.asarray(q[..., 1:] * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-150))


def turns_between(A: Floats, quaternions: Floats) -> tuple[Floats, Floats]:
    """Return the rotation vectors (N, 3, M), rad, from each transform to each of M rotations, in the axes of the first.

    Args:
        A: (N, 4, 4).
        quaternions: (M, K, 4) of unit length, K equivalent rotations of each: the one that is turned least counts.

    Returns:
        The rotation vectors; and (N, M) their angles over the sines of half of them, 2 where nothing is turned.
    """
    count, equivalent = quaternions.shape[:2]
    q = quaternions_from(A) @ np.ascontiguousarray(quaternions.reshape(-1, 4).T)
    if equivalent > 1:
        q = q.reshape(len(A), 4, count, equivalent)
        nearest = np.abs(q[:, 0]).argmax(axis=-1)
        q = np.take_along_axis(q, nearest[:, None, :, None], axis=3)[..., 0]
    sine = np.sqrt(q[:, 1] ** 2 + q[:, 2] ** 2 + q[:, 3] ** 2)
    turn = 2.0 * np.arctan2(sine, np.abs(q[:, 0]))
    per_sine = np.divide(turn, sine, out=np.full_like(sine, 2.0), where=sine > 1e-150)
    return q[:, 1:] * np.where(q[:, 0] < 0, -per_sine, per_sine)[:, None], per_sine


def quaternions_from(A: Floats) -> Floats:
    """Return matrices (N, 4, 4) that multiply a rotation's quaternion to that from each transform (N, 4, 4) to it."""
    conjugate = quaternion(A[:, :3, :3]) * [1.0, -1.0, -1.0, -1.0]
    w, v = conjugate[:, :1, None], conjugate[:, 1:]
    left = np.zeros((len(A), 4, 4))
    left[:, :1, :1], left[:, 0, 1:], left[:, 1:, 0] = w, -v, v
    left[:, 1:, 1:] = w * _UNIT + skew(v)
    return left


def angle(T: Floats) -> Floats:
    """Return the angles (...), rad from 0 to pi, by which transforms (..., 4, 4) or rotations (..., 3, 3) turn."""
    return np.asarray(np.linalg.norm(rotation_vector(T[..., :3, :3]), axis=-1))


def exp(xi: ArrayLike) -> Floats:
    """Return the transforms Exp(xi) (..., 4, 4) of tangent vectors (..., 6), rotation first, rad and metres."""
    tangent = np.asarray(xi, float)
    W = skew(tangent[..., :3])
    WW = W @ W
    first, second, third = _coefficients(np.linalg.norm(tangent[..., :3], axis=-1))
    V = _UNIT + second * W + third * WW
    return transform(_UNIT + first * W + second * WW, (V @ tangent[..., 3:, None])[..., 0])


def log(T: Floats) -> Floats:
    """Return the tangent vectors (..., 6), rotation first, rad and metres, of transforms (..., 4, 4)."""
    w = rotation_vector(T[..., :3, :3])
    return np.concatenate([w, (_inverse_left_jacobian(w) @ T[..., :3, 3:])[..., 0]], axis=-1)


def difference(A: Floats, B: Floats) -> Floats:
    """Return xi (..., 6) with B = A Exp(xi), rotation first, of transforms (..., 4, 4)."""
    functions = library()
    if functions is None or B.shape[-2:] != (4, 4) or A.shape not in ((4, 4), B.shape):
        return log(inverse(A) @ B)
    a, b = (np.ascontiguousarray(T, dtype=np.float64) for T in (A, B))
    xi = np.empty((*b.shape[:-2], 6))
    functions.differences(xi.size // 6, A.ndim > 2, address(a), address(b), address(xi))
    return xi


def adjoint(T: Floats) -> Floats:
    """Return Ad(T) (..., 6, 6): T Exp(xi) = Exp(Ad(T) xi) T, rotation first."""
    R = T[..., :3, :3]
    Ad = np.zeros((*T.shape[:-2], 6, 6))
    Ad[..., :3, :3] = Ad[..., 3:, 3:] = R
    Ad[..., 3:, :3] = skew(T[..., :3, 3]) @ R
    return Ad


def right_jacobian(xi: ArrayLike) -> Floats:
    """Return J_r(xi) (..., 6, 6), rotation first: Exp(xi + d) = Exp(xi) Exp(J_r(xi) d) to first order.

    Args:
        xi: (..., 6) tangent vectors, rotation first, rad and metres.
    """
    tangent = -np.asarray(xi, float)  # J_r(xi) = J_l(-xi)
    W, P = skew(tangent[..., :3]), skew(tangent[..., 3:])
    theta = np.linalg.norm(tangent[..., :3], axis=-1)
    _, second, third = _coefficients(theta)
    fourth, fifth = _fourth(theta), _fifth(theta)
    WP, PW, WW = W @ P, P @ W, W @ W
    WPW = W @ PW
    J = np.zeros((*tangent.shape[:-1], 6, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = _UNIT + second * W + third * WW
    J[..., 3:, :3] = (
        0.5 * P + third * (WP + PW + WPW) + fourth * (W @ WP + PW @ W - 3 * WPW) + fifth * (WPW @ W + W @ WPW)
    )
    return J


def inverse_right_jacobian(xi: ArrayLike) -> Floats:
    """Return J_r(xi)^-1 (..., 6, 6), rotation first: Log(Exp(xi) Exp(d)) = xi + J_r(xi)^-1 d to first order.

    Args:
        xi: (..., 6) tangent vectors, rotation first, rad and metres; the rotation at most pi.
    """
    return np.asarray(np.linalg.inv(right_jacobian(xi)))


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


def relative_covariance(T_a_b: Floats, covariance: Floats, a: slice | None, b: slice | None) -> Floats:
    """Return the covariance (6, 6) of T_a_b = T_a^-1 T_b, of its right perturbation.

    Args:
        T_a_b: (4, 4).
        covariance: (n, n), with rows for the right perturbations of T_a and T_b.
        a: rows of the perturbation of T_a, rotation first; None: T_a is exact.
        b: rows of the perturbation of T_b, likewise.
    """
    J = np.zeros((6, len(covariance)))
    # (T_a Exp(x_a))^-1 T_b Exp(x_b) = T_a_b Exp(x_b - Ad(T_b_a) x_a)
    if b is not None:
        J[:, b] += np.eye(6)
    if a is not None:
        J[:, a] -= adjoint(inverse(T_a_b))
    return np.asarray(J @ covariance @ J.T)


def _coefficients(theta: Floats) -> tuple[Floats, Floats, Floats]:
    """sin(x) / x, (1 - cos(x)) / x^2 and (x - sin(x)) / x^3 of angles (...), each as (..., 1, 1)."""
    return *_first_two(theta), _third(theta)


def _first_two(theta: Floats) -> tuple[Floats, Floats]:
    """sin(x) / x and (1 - cos(x)) / x^2 of angles (...), each as (..., 1, 1)."""
    half = 0.5 * theta[..., None, None]
    sinc = np.divide(np.sin(half), half, out=np.ones_like(half), where=half > 0)
    return sinc * np.cos(half), 0.5 * sinc * sinc


def _third(theta: Floats) -> Floats:
    """(x - sin(x)) / x^3 of angles (...), as (..., 1, 1)."""
    return _series(theta, _THIRD, lambda x: (x - np.sin(x)) / x**3)


def _fourth(theta: Floats) -> Floats:
    """(x^2 / 2 + cos(x) - 1) / x^4 of angles (...), as (..., 1, 1)."""
    return _series(theta, _FOURTH, lambda x: (0.5 * x**2 + np.cos(x) - 1) / x**4)


def _fifth(theta: Floats) -> Floats:
    """(2 x - 3 sin(x) + x cos(x)) / (2 x^5) of angles (...), as (..., 1, 1)."""
    return _series(theta, _FIFTH, lambda x: (2 * x - 3 * np.sin(x) + x * np.cos(x)) / (2 * x**5))


def _series(theta: Floats, coefficients: Sequence[float], closed: Callable[[Floats], Floats]) -> Floats:
    """Sum c_k theta^(2 k) below the small angle, c the highest first, and the closed form above it, as (..., 1, 1)."""
    small = theta < _SMALL_ANGLE
    squared = np.square(np.where(small, theta, 0.0))
    value = coefficients[0] * squared
    for c in coefficients[1:-1]:
        value += c
        value *= squared
    value += coefficients[-1]
    if not small.all():
        value = np.where(small, value, closed(np.where(small, np.pi, theta)))
    return np.asarray(value)[..., None, None]


def _inverse_left_jacobian(w: Floats) -> Floats:
    """Return J_l(w)^-1 (..., 3, 3) of SO(3), w at most pi long: I - W / 2 + (1 - (x / 2) cot(x / 2)) / x^2 W^2."""
    theta, W = np.linalg.norm(w, axis=-1), skew(w)
    _, second, third = _coefficients(theta)
    return np.asarray(_UNIT - 0.5 * W + (0.5 * third - _fourth(theta)) / second * (W @ W))


def quaternion(R: Floats) -> Floats:
    """Unit quaternions (..., 4), real part first, of rotations (..., 3, 3)."""
    d = [R[..., i, i] for i in range(3)]
    trace = d[0] + d[1] + d[2]
    # Four multiples of the quaternion, row k by 4 q_k: the multiple by the largest entry loses no digits.
    rows = np.empty((*trace.shape, 4, 4))
    rows[..., 0, 0] = 1.0 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows[..., i + 1, i + 1] = 1.0 + 2.0 * d[i] - trace
        rows[..., 0, i + 1] = rows[..., i + 1, 0] = R[..., k, j] - R[..., j, k]
        rows[..., j + 1, k + 1] = rows[..., k + 1, j + 1] = R[..., k, j] + R[..., j, k]
    largest = np.diagonal(rows, axis1=-2, axis2=-1).argmax(axis=-1)
    q = np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    return np.asarray(q / np.sqrt(np.vecdot(q, q))[..., None])
