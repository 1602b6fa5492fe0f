"""The transform between two sensors from poses of shared targets, when some poses are wrong or ambiguous."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.se3 import angle, inverse, transform

MOST_HYPOTHESES = 400
DIFFERENT = (np.radians(15.0), 0.3)
"""Rotation, rad, and translation, metres, beyond which two transforms are different answers."""

TOLERANCES = ((0.10, np.radians(6.0)), (0.05, np.radians(4.0)), (0.03, np.radians(2.5)))
"""Standard deviations of centre and rotation at 2 m range: loose while the transform rests on one view, then tighter.
Both are those of a LiDAR's pose of a target of about a metre; the centre's grows with range."""

CUT = 3.0
"""Standard deviations at which a view stops counting against a transform."""

TIE = 1.0
"""Squared standard deviations by which two readings of a placement count as equally good."""


@dataclass(frozen=True, eq=False, repr=False)
class Consensus(Value):
    """What most placements agree on.

    Attributes:
        T_a_b: (4, 4).
        inlier: (V,) which placements agree.
        chosen: (V, 2) which candidate of each sensor agrees best.
        cost: truncated squared distances, summed over the placements.
        runner_up: the cost of the best different answer; inf if there is none.
    """

    T_a_b: Floats
    inlier: Bools
    chosen: Ints
    cost: float
    runner_up: float


def relative_pose(a: Sequence[Floats], b: Sequence[Floats]) -> Consensus:
    """Find T_a_b from candidate poses of V placements as seen by two sensors.

    Every pair of candidates of every placement is a hypothesis (one placement fixes all six degrees of freedom);
    each is refined on the placements that agree with it, by a rigid fit to target centres, plane normals and
    in-plane axes at once (Wahba's problem with points: Umeyama, PAMI 1991), and the cheapest wins. No initial
    guess is needed, and placements that are wrong are outvoted.

    Args:
        a: for each placement, (I, 4, 4) candidate poses T_a_target, the plainest first.
        b: for each placement, (J, 4, 4) candidate poses T_b_target.
    """
    A, B = _padded(a), _padded(b)
    placements = range(len(A))
    hypotheses = np.concatenate([np.reshape(a[v][:, None] @ inverse(b[v])[None], (-1, 4, 4)) for v in placements])
    step = max(1, len(hypotheses) // MOST_HYPOTHESES)
    fits = [_refined(E, A, B) for E in hypotheses[::step]]
    best = min(fits, key=lambda fit: fit.cost)
    others = [fit.cost for fit in fits if _different(fit.T_a_b, best.T_a_b)]
    return Consensus(best.T_a_b, best.inlier, best.chosen, best.cost, min(others, default=np.inf))


def rigid_fit(A: Floats, B: Floats, sigma_centre: Floats, sigma_angle: float) -> Floats:
    """Return T_a_b (4, 4) that carries poses B (V, 4, 4) of targets to their poses A (V, 4, 4), least squares."""
    w = 1 / sigma_centre**2
    mean_a, mean_b = w @ A[:, :3, 3] / w.sum(), w @ B[:, :3, 3] / w.sum()
    centres = np.einsum("v,vi,vj->ij", w, A[:, :3, 3] - mean_a, B[:, :3, 3] - mean_b)
    # A rotation by a small angle moves the three axes by 2 angle^2 in all.
    axes = np.einsum("vik,vjk->ij", A[:, :3, :3], B[:, :3, :3]) / (2 * sigma_angle**2)
    U, _, Vt = np.linalg.svd(centres + axes)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return transform(R, mean_a - R @ mean_b)


def _refined(E: Floats, A: Floats, B: Floats) -> Consensus:
    rows = np.arange(len(A))
    for sigma_centre, sigma_angle in TOLERANCES:
        for _ in range(3):
            distance, i, j, sigma = distances(E, A, B, sigma_centre, sigma_angle)
            near = distance < CUT**2
            if not near.any():
                break
            E = rigid_fit(A[rows, i][near], B[rows, j][near], sigma[near], sigma_angle)
    distance, i, j, _ = distances(E, A, B)
    cost = float(np.minimum(distance, CUT**2).sum())
    return Consensus(E, distance < CUT**2, np.column_stack([i, j]), cost, np.inf)


def distances(
    E: Floats, A: Floats, B: Floats, sigma_centre: float = TOLERANCES[-1][0], sigma_angle: float = TOLERANCES[-1][1]
) -> tuple[Floats, Ints, Ints, Floats]:
    """Compare the candidates of V placements under T_a_b = E.

    Args:
        E: (4, 4).
        A: (V, I, 4, 4) candidates of the first sensor, nan where there are fewer.
        B: (V, J, 4, 4) candidates of the second.
        sigma_centre: standard deviation of a centre at 2 m, metres.
        sigma_angle: standard deviation of a rotation, rad.

    Returns:
        (V,) least squared distance, the candidates that it is between, (V,) each, and the centres' standard
        deviations (V,).
    """
    P = (E @ B)[:, None]
    centre = np.linalg.norm(A[:, :, None, :3, 3] - P[..., :3, 3], axis=-1)
    trace = np.einsum("vikl,vjkl->vij", A[..., :3, :3], P[:, 0, :, :3, :3])
    turn = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    sigma = sigma_centre * np.maximum(np.linalg.norm(B[:, 0, :3, 3], axis=-1) / 2.0, 1.0)
    squared = (centre / sigma[:, None, None]) ** 2 + (turn / sigma_angle) ** 2
    squared = np.where(np.isnan(squared), np.inf, squared)
    flat = squared.reshape(len(A), -1)
    # Of readings that agree about as well, the first: which of two mirrored labellings it is must not depend on noise.
    best = (flat <= flat.min(axis=1, keepdims=True) + TIE).argmax(axis=1)
    i, j = np.unravel_index(best, squared.shape[1:])
    return flat[np.arange(len(A)), best], i, j, sigma


def _padded(candidates: Sequence[Floats]) -> Floats:
    """Stack candidate lists of different lengths, the missing ones being not-a-number."""
    stack = np.full((len(candidates), max(len(c) for c in candidates), 4, 4), np.nan)
    for row, poses in zip(stack, candidates, strict=True):
        row[: len(poses)] = poses
    return stack


def _different(T: Floats, U: Floats) -> bool:
    return bool(angle(inverse(T) @ U) > DIFFERENT[0] or np.linalg.norm(T[:3, 3] - U[:3, 3]) > DIFFERENT[1])
