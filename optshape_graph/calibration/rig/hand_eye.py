"""Two sensors on one platform, each of which knows only how it moved: A X = X B."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from optshape_graph._arrays import Bools, Floats
from optshape_graph.se3 import inverse, rotation_vector, transform

LEAST_TURN = np.radians(3.0)
"""Turn from which on a motion says how two sensors are turned to each other, rad."""

SPREAD = np.radians(2.0)
"""How far, root mean square, turns must spread about a second axis, rad."""

AGREE = (np.radians(6.0), 0.3)
"""Rotation, rad, and translation, metres, by which a motion may be off: single scans make it."""

DRAWS = 200
"""Pairs of motions that are tried."""


class Motion(NamedTuple):
    """How a sensor moved.

    Attributes:
        moments: numbers of the moments before and after.
        T_m_n: (4, 4) the sensor's pose at the second in its frame at the first.
    """

    moments: tuple[int, int]
    T_m_n: Floats


class HandEye(NamedTuple):
    """Where two sensors are, by how both moved.

    Attributes:
        T_a_b: (4, 4).
        agree: number of motions that agree on it.
        of: number of motions that turn enough to tell.
    """

    T_a_b: Floats
    agree: int
    of: int


def hand_eye(pairs: Sequence[tuple[Floats, Floats]]) -> HandEye | None:
    """Find X = T_a_b of motions A = X B X^-1 (4, 4) of two sensors; None where they do not tell it.

    A turns about an axis that X carries the axis of B to, by the same angle: Wahba's problem for the rotation; then
    (R_A - 1) t = R t_B - t_A for the translation (Park and Martin, IEEE T-RA 1994). Some motions may be wrong: the X of
    two of them with which most agree is refined on those. Of what no motion tells, such as the height where all turns
    are about the vertical, the least is taken.

    Args:
        pairs: A and B (4, 4), metres, of motions between the same two moments.
    """
    turned = [(A, B) for A, B in pairs if min(_turn(A), _turn(B)) > LEAST_TURN]
    if len(turned) < 2:
        return None
    A, B = (np.array(one) for one in zip(*turned, strict=True))
    rng = np.random.default_rng(0)
    best: Bools = np.zeros(len(A), bool)
    for _ in range(DRAWS):
        chosen = rng.choice(len(A), 2, replace=False)
        X = _fitted(A[chosen], B[chosen])
        if X is not None and (agree := _agreeing(X, A, B)).sum() > best.sum():
            best = agree
    X = _fitted(A[best], B[best]) if best.sum() >= 2 else None
    return None if X is None else HandEye(X, int(best.sum()), len(A))


def _fitted(A: Floats, B: Floats) -> Floats | None:
    a, b = rotation_vector(A[:, :3, :3]), rotation_vector(B[:, :3, :3])
    if np.linalg.svd(a, compute_uv=False)[1] < SPREAD * np.sqrt(len(a)):
        return None  # all turns about one axis: any turn about it would do
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    rows = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    t = np.linalg.lstsq(rows, (B[:, :3, 3] @ R.T - A[:, :3, 3]).ravel(), rcond=1e-3)[0]
    return transform(R, t)


def _agreeing(X: Floats, A: Floats, B: Floats) -> Bools:
    off = inverse(A @ X) @ (X @ B)
    turn, shift = np.linalg.norm(rotation_vector(off[:, :3, :3]), axis=1), np.linalg.norm(off[:, :3, 3], axis=1)
    return np.asarray((turn < AGREE[0]) & (shift < AGREE[1]))


def _turn(T: Floats) -> float:
    return float(np.linalg.norm(rotation_vector(T[:3, :3])))
