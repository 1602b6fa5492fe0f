"""The dual of the relaxation in closed form: a certificate of a known pose, without a semidefinite programme.

A minimum is known; only that no rotation costs less has to be shown. Any multipliers of the rotation constraints give a
rigorous bound (see `certificate`), so those that are tight at the known rotation R* are written down:

1. R = W R* takes the cost to a form F in w = [vec W; 1], whose minimum is at W = I, and keeps the constraints.
2. Subtract the cost, and Gamma : (W^T W - I) with Gamma the symmetric part of the gradient at I. What is left, Z, and
   its gradient vanish at W = I. (W W^T serves as well as W^T W, and so does the mean of both.)
3. The points of a planar target lie in x = 0, so F says nothing of the first column of W. Two constraints that vanish
   on rotations, with zero gradient at I, lend it some of what F says of the other two columns:

       C = W_yx^2 + W_zx^2 - W_xy^2 - W_xz^2,    D = (W_xx - 1)^2 - (W_yy - W_zz)^2 - (W_yz + W_zy)^2.

   Z + c C + d D stays positive on those columns where c / c_max + d / d_max < 1; 0.45 of each is taken.
4. The smallest eigenvalue of the (10, 10) sum decides.
"""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Bools, Floats

_SHARE = 0.45
"""Of c_max and d_max: the two together leave a tenth of what the form says of the last two columns of W."""

_TIGHT = 1e-11
"""Gap, relative to the trace of the form, below which other multipliers would gain nothing."""

_ROUNDING = 1e-12
"""Second eigenvalue, relative to the trace of the form, that is rounding."""

_I = np.append(np.eye(3).ravel(), 1.0)  # [vec W; 1] at W = I; W_ij is entry 3 j + i
_LAST_COLUMNS = np.array([3, 4, 5, 6, 7, 8])
_PLANE = np.zeros((10, 2))  # W_xy, W_xz
_PLANE[3, 0] = _PLANE[6, 1] = 1.0
_STRAIN = np.zeros((10, 2))  # W_yy - W_zz, W_yz + W_zy
_STRAIN[[4, 8, 5, 7], [0, 0, 1, 1]] = 1.0, -1.0, 1.0, 1.0
_FIRST = np.zeros(10)  # W_xx - 1
_FIRST[[0, 9]] = 1.0, -1.0
_C = np.diag([0.0, 1.0, 1.0, 0, 0, 0, 0, 0, 0, 0]) - _PLANE @ _PLANE.T
_D = np.outer(_FIRST, _FIRST) - _STRAIN @ _STRAIN.T


def closed_form_bounds(forms: Floats, rotations: Floats) -> tuple[Floats, Floats]:
    """Bound quadratic costs over all rotations from below, by multipliers that are tight at known minima.

    Args:
        forms: (B, 10, 10) costs x^T F x of x = [vec R (column-major); 1].
        rotations: (B, 3, 3) rotations, a minimum of each cost, such as `certificate.refine_rotation` gives. Elsewhere
            the bound still holds, but is far below.

    Returns:
        The bounds (B,), -inf where the form leaves the last two columns of W undetermined; and the second smallest
        eigenvalue (B,) of the dual's matrix, in the cost's unit, 0 where it is rounding.
    """
    count = len(forms)
    scale = np.trace(forms, axis1=1, axis2=2)
    to_identity = np.zeros((count, 10, 10))
    to_identity[:, :9, :9] = _kronecker(np.swapaxes(rotations, 1, 2), np.eye(3)[None])
    to_identity[:, 9, 9] = 1.0
    F = np.swapaxes(to_identity, 1, 2) @ (forms / scale[:, None, None]) @ to_identity
    gradient = F @ _I
    cost = gradient @ _I
    by_entry = gradient[:, :9].reshape(count, 3, 3)
    Gamma = 0.5 * (by_entry + np.swapaxes(by_entry, 1, 2))

    bound, second = np.full(count, -np.inf), np.zeros(count)
    for of_columns in (1.0, 0.0, 0.5):  # W^T W, W W^T, the mean of both
        left = np.flatnonzero(cost - bound > _TIGHT)
        if not len(left):
            break
        Z = F[left] - _gram(Gamma[left], of_columns)
        Z[:, 9, 9] -= cost[left]
        lent, determined = _lent(Z)
        eigenvalues = np.linalg.eigvalsh(Z + lent)
        found = np.where(determined, cost[left] + 4.0 * np.minimum(0.0, eigenvalues[:, 0]), -np.inf)
        better = found > bound[left]
        bound[left[better]] = found[better]
        second[left[better]] = np.where(eigenvalues[better, 1] > _ROUNDING, eigenvalues[better, 1], 0.0)
    return bound * scale, second * scale


def _kronecker(A: Floats, B: Floats) -> Floats:
    """Return the Kronecker products (K, 9, 9) of matrices (K, 3, 3)."""
    return np.asarray((A[:, :, None, :, None] * B[:, None, :, None, :]).reshape(-1, 9, 9))


def _gram(Gamma: Floats, of_columns: float) -> Floats:
    """Return the forms (K, 10, 10) of Gamma : (G - I), G = W^T W for a share `of_columns` and W W^T for the rest."""
    one = np.eye(3)[None]
    form = np.zeros((len(Gamma), 10, 10))
    form[:, :9, :9] = of_columns * _kronecker(Gamma, one) + (1.0 - of_columns) * _kronecker(one, Gamma)
    form[:, 9, 9] = -np.trace(Gamma, axis1=1, axis2=2)
    return form


def _lent(Z: Floats) -> tuple[Floats, Bools]:
    """Return c C + d D (K, 10, 10) for forms Z (K, 10, 10), and where Z determines the last two columns of W (K,)."""
    block = Z[:, _LAST_COLUMNS[:, None], _LAST_COLUMNS]
    values, vectors = np.linalg.eigh(block)
    determined = values[:, 0] > 1e-12 * values[:, -1]
    inverse = (vectors / np.where(determined[:, None], values, 1.0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    share = [_SHARE / _largest(A[_LAST_COLUMNS].T @ inverse @ A[_LAST_COLUMNS]) for A in (_PLANE, _STRAIN)]
    return share[0][:, None, None] * _C + share[1][:, None, None] * _D, determined


def _largest(A: Floats) -> Floats:
    """Return the largest eigenvalues (K,) of symmetric matrices (K, 2, 2)."""
    half = 0.5 * (A[:, 0, 0] - A[:, 1, 1])
    return np.asarray(0.5 * (A[:, 0, 0] + A[:, 1, 1]) + np.hypot(half, A[:, 0, 1]))
