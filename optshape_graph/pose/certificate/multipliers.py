"""Multipliers of the dual that are tight at known minima: written down but for fourteen, which Newton steps find.

For a minimum R*:

1. R = W R* takes the cost to a form F in w = [vec W; 1], whose minimum is at W = I, and keeps the constraints.
2. Subtract the cost, and Gamma : (W^T W - I) with Gamma the symmetric part of the gradient at I. What is left, Z, and
   its gradient vanish at W = I. So they do when any of the constraints are added that have zero gradient at I: a space
   of 14 dimensions, the same for all costs.
3. Which of these make Z positive definite beside w, a few damped Newton steps find, towards the analytic centre of
   Z + y.B + s I >= 0 (Nesterov and Nemirovskii, Interior-point polynomial algorithms, 1994), while s falls to zero.
4. The smallest eigenvalue of the (10, 10) sum decides.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.pose.certificate.relaxation import SQUARED_NORM, rotation_constraints

_STEPS = 8
"""Newton steps at most: of 500 simulated scans' costs all but three take up to four."""

_INSIDE = 1e-11
"""Smallest eigenvalue, relative to the trace of the form, from which on it is positive beyond rounding."""

_FIRST_SHIFT, _SHIFT_LEFT = 1e-4, 0.2
"""The shift s begins so far above what is needed, relative to the trace of the form, and keeps this share of it at each
step that ends near the centre."""

_ROUNDING = 1e-12
"""Second eigenvalue, relative to the trace of the form, that is rounding."""

_I = np.append(np.eye(3).ravel(), 1.0)  # [vec W; 1] at W = I; W_ij is entry 3 j + i


def closed_form_bounds(forms: Floats, rotations: Floats) -> tuple[Floats, Floats]:
    """Bound quadratic costs over all rotations from below, by multipliers that are tight at known minima.

    Args:
        forms: (B, 10, 10) costs x^T F x of x = [vec R (column-major); 1].
        rotations: (B, 3, 3) rotations, a minimum of each cost; elsewhere the bound still holds, but is far below.

    Returns:
        The bounds (B,), and the second smallest eigenvalue (B,) of the dual's matrix, in the cost's unit, 0 where it is
        rounding.
    """
    count = len(forms)
    trace = np.trace(forms, axis1=1, axis2=2)
    scale = np.where(trace > 0, trace, 1.0)
    to_identity = np.zeros((count, 10, 10))
    to_identity[:, :9, :9] = _kronecker(np.swapaxes(rotations, 1, 2), np.eye(3)[None])
    to_identity[:, 9, 9] = 1.0
    F = np.swapaxes(to_identity, 1, 2) @ (forms / scale[:, None, None]) @ to_identity
    gradient = F @ _I
    cost = gradient @ _I
    by_entry = gradient[:, :9].reshape(count, 3, 3)
    Gamma = 0.5 * (by_entry + np.swapaxes(by_entry, 1, 2))
    Z = F.copy()
    Z[:, :9, :9] -= _kronecker(Gamma, np.eye(3)[None])
    Z[:, 9, 9] += np.trace(Gamma, axis1=1, axis2=2) - cost
    Z += np.tensordot(_positive_with(Z), _flat_constraints(), 1)
    eigenvalues = np.linalg.eigvalsh(Z)
    second = np.where(eigenvalues[:, 1] > _ROUNDING, eigenvalues[:, 1], 0.0)
    return (cost + SQUARED_NORM * np.minimum(0.0, eigenvalues[:, 0])) * scale, second * scale


def _positive_with(Z: Floats) -> Floats:
    """Return multipliers (B, 14) of the flat constraints that make forms (B, 10, 10) positive definite beside w.

    Where there are none, or more steps are needed, they are those that come nearest in so many steps.
    """
    B, beside = _flat_constraints(), _beside_identity()
    B, Z = beside.T @ B @ beside, beside.T @ Z @ beside
    y, shift, centred = np.zeros((len(Z), len(B))), np.zeros(len(Z)), np.zeros(len(Z), dtype=bool)
    left = np.arange(len(Z))
    for step in range(_STEPS):
        A = Z[left] + np.tensordot(y[left], B, 1)
        lowest = np.linalg.eigvalsh(A)[:, 0]
        outside = lowest <= _INSIDE
        left, A, needed = left[outside], A[outside], np.maximum(-lowest[outside], 0.0)
        if not len(left):
            break
        lowered = needed + np.maximum(_SHIFT_LEFT * (shift[left] - needed), _INSIDE)
        shift[left] = np.where(centred[left], lowered, shift[left]) if step else 1.5 * needed + _FIRST_SHIFT
        whiten = np.linalg.inv(np.linalg.cholesky(A + shift[left, None, None] * np.eye(9)))
        white = (whiten[:, None] @ B @ np.swapaxes(whiten, 1, 2)[:, None]).reshape(len(left), len(B), 81)
        slope = white @ np.eye(9).ravel()
        newton = np.linalg.solve(white @ np.swapaxes(white, 1, 2), slope[..., None])[..., 0]
        decrement = np.sqrt(np.maximum((slope * newton).sum(axis=1), 0.0))
        y[left] += newton / (1.0 + decrement)[:, None]
        centred[left] = decrement < 1.0
    return y


@lru_cache(maxsize=1)
def _flat_constraints() -> Floats:
    """(14, 10, 10): a basis of the combinations of the constraints whose gradient vanishes at W = I, too."""
    _, sizes, basis = np.linalg.svd(rotation_constraints().reshape(-1, 100), full_matrices=False)
    basis = basis[sizes > 1e-9].reshape(-1, 10, 10)
    _, sizes, combined = np.linalg.svd((basis @ _I).T)
    return np.asarray(np.tensordot(combined[np.count_nonzero(sizes > 1e-9) :], basis, 1))


@lru_cache(maxsize=1)
def _beside_identity() -> Floats:
    """(10, 9) orthonormal columns, at right angles to [vec I; 1]."""
    return np.asarray(np.linalg.svd(_I[None])[2][1:].T)


def _kronecker(A: Floats, B: Floats) -> Floats:
    """Return the Kronecker products (K, 9, 9) of matrices (K, 3, 3)."""
    return np.asarray((A[:, :, None, :, None] * B[:, None, :, None, :]).reshape(-1, 9, 9))
