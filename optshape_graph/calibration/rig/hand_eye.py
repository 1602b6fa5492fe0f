"""Two sensors on one platform, each of which knows only how it moved: A X = X B."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.se3 import inverse, rotation_vector, transform

LEAST_TURN = np.radians(3.0)
"""Turn from which on a motion says how two sensors are turned to each other, rad."""

OUTLYING = 4.0
"""Multiple of the median error beyond which a motion is left out."""


class Motion(NamedTuple):
    """How a sensor moved.

    Attributes:
        moments: numbers of the moments before and after.
        T_m_n: (4, 4) the sensor's pose at the second in its frame at the first.
    """

    moments: tuple[int, int]
    T_m_n: Floats


def hand_eye(pairs: Sequence[tuple[Floats, Floats]]) -> Floats | None:
    """Return X = T_a_b (4, 4) of motions A = X B X^-1 (4, 4) of two sensors; None where they are too few or too small.

    A turns about an axis that X carries the axis of B to, by the same angle: Wahba's problem for the rotation; then
    (R_A - 1) t = R t_B - t_A for the translation (Park and Martin, IEEE T-RA 1994). Of what no motion tells, such as
    the height where all turns are about the vertical, the least is taken.

    Args:
        pairs: of motions between the same two moments.
    """
    turned = [(A, B) for A, B in pairs if min(_turn(A), _turn(B)) > LEAST_TURN]
    for _ in range(3):
        if len(turned) < 2:
            return None
        A, B = (np.array(one) for one in zip(*turned, strict=True))
        a, b = rotation_vector(A[:, :3, :3]), rotation_vector(B[:, :3, :3])
        U, s, Vt = np.linalg.svd(a.T @ b)
        if s[1] < LEAST_TURN * s[0]:
            return None  # all turns about one axis: any turn about it would do
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        rows = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
        t = np.linalg.lstsq(rows, (B[:, :3, 3] @ R.T - A[:, :3, 3]).ravel(), rcond=1e-3)[0]
        X = transform(R, t)
        off = np.array([_turn(inverse(A_ @ X) @ X @ B_) for A_, B_ in turned])
        kept = off <= OUTLYING * max(float(np.median(off)), np.radians(0.1))
        if kept.all():
            return X
        turned = [pair for pair, keep in zip(turned, kept, strict=True) if keep]
    return X


def _turn(T: Floats) -> float:
    return float(np.linalg.norm(rotation_vector(T[:3, :3])))
