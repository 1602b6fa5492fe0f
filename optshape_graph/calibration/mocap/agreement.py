"""Whether most scans agree on where the motion capture is, and, where they don't, what is wrong with the session.

One scan with its markers fixes T_lidar_mocap, so the scans vote. What can be wrong with all of them at once, an export
of the other handedness or frames in another order, is tried where the vote finds those who disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import linear_sum_assignment

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.calibration.consensus import CUT, Consensus, distances, relative_pose
from optshape_graph.calibration.mocap.comparison import MocapScan, fit_template
from optshape_graph.errors import EstimationError
from optshape_graph.se3 import angle, inverse

MIRROR = np.array([1.0, -1.0, 1.0])
"""What makes left-handed coordinates right-handed; which axis is negated, or which two are swapped, is the same."""

SAME_PLACE = (0.05, np.radians(5.0))
"""Distance, metres, and angle, rad, within which two poses of the target count as one placement."""


@dataclass(frozen=True, eq=False, repr=False)
class Agreement(Value):
    """What most scans agree on.

    Attributes:
        scans: all of them, the vertices of a symmetric target named as the markers are.
        T_lidar_mocap: (4, 4), roughly.
        agreeing: (V,) which scans agree with it.
    """

    scans: tuple[MocapScan, ...]
    T_lidar_mocap: Floats
    agreeing: Bools


def find_agreement(scans: Sequence[MocapScan], where: str) -> Agreement:
    """Let the scans vote on T_lidar_mocap.

    Args:
        scans: at least two.
        where: the session's file, for messages.

    Raises:
        EstimationError: no majority of the scans agrees; the message says what seems to be wrong, be it the markers'
            handedness, the frames' order, or one frame or scan that stands for all.
    """
    found = _vote(scans)
    agree = int(found.inlier.sum())
    if agree < len(scans):
        if reason := _what_is_wrong_with_all(scans, found):
            raise EstimationError(f"{where}: {reason}")
        if 2 * agree <= len(scans):
            raise EstimationError(
                f"{where}: no more than {agree} of {len(scans)} scans agree on where the motion capture is: do the "
                f"scans and the marker frames belong together? {_listed(scans, found)}"
            )
    named = tuple(
        replace(scan, estimate=scan.estimate.equivalent(int(k))) if k else scan
        for scan, k in zip(scans, found.chosen[:, 1], strict=True)
    )
    return Agreement(named, inverse(found.T_a_b), found.inlier)


def without_fallen_marker(scans: Sequence[MocapScan], doubted: Sequence[int]) -> tuple[tuple[MocapScan, ...], int]:
    """Leave out, in all scans, that marker without which they agree best.

    Args:
        scans: at least two.
        doubted: indices of the vertices whose marker may be it, one at least.

    Returns:
        The scans without it, and the index of its vertex.
    """
    tried = []
    for k in doubted:
        rest = tuple(replace(scan, markers=_without(scan.markers, k)) for scan in scans)
        tried.append((_vote(rest).cost, k, rest))
    _, k, rest = min(tried, key=lambda one: one[0])
    return rest, k


def placements(scans: Sequence[MocapScan]) -> int:
    """Count the different places and angles at which the target stood."""
    counted: list[MocapScan] = []
    for scan in scans:
        if not any(_same_place(scan, other) for other in counted):
            counted.append(scan)
    return len(counted)


def other_frame(scan: MocapScan, scans: Sequence[MocapScan], T_lidar_mocap: Floats) -> str:
    """Say which other scan's markers fit a scan that does not agree with its own; empty: none.

    Args:
        scan: the one that does not agree.
        scans: all of them.
        T_lidar_mocap: (4, 4) by those that do.
    """
    fitting = [
        other.name for other in scans
        if other is not scan and _fit(T_lidar_mocap, other.T_mocap_target, scan.estimate.equivalent_poses) < CUT**2
    ]  # fmt: skip
    return f"; it fits the markers of {fitting[0]} instead: were they swapped?" if len(fitting) == 1 else ""


def _vote(scans: Sequence[MocapScan], mirror: Floats | float = 1.0) -> Consensus:
    """Find T_mocap_lidar, the markers' coordinates being multiplied by `mirror` first."""
    by_markers = [fit_template(scan.estimate.target, scan.markers * mirror, scan.name)[None] for scan in scans]
    return relative_pose(by_markers, [scan.estimate.equivalent_poses for scan in scans])


def _what_is_wrong_with_all(scans: Sequence[MocapScan], found: Consensus) -> str:
    agree = int(found.inlier.sum())
    differ = f"{len(scans)} scans"
    if 2 * agree <= len(scans):
        if len({scan.frame for scan in scans}) == 1:
            return f"all {differ} name marker frame {scans[0].frame}, but the target did not stand in one place"
        if all(np.array_equal(scan.estimate.vertices, scans[0].estimate.vertices) for scan in scans):
            return f"all {differ} hold the same returns, but their markers are in different places"
    mirrored = _vote(scans, MIRROR)
    if mirrored.inlier.sum() > agree and mirrored.cost < found.cost / 2:
        return (
            f"the markers are mirrored: {agree} of {differ} agree as they are, {int(mirrored.inlier.sum())} with one "
            f"axis negated: is the export left-handed, or are two axes swapped?"
        )
    if 2 * agree <= len(scans) and (order := _permutation(scans)):
        return f"the marker frames look permuted: {order}"
    return ""


def _permutation(scans: Sequence[MocapScan]) -> str:
    """Say which scan fits which frame, if three quarters of them (three at least) fit some frames; else empty."""
    T_mocap_target = np.array([scan.T_mocap_target for scan in scans])
    T_lidar_target = np.array([scan.estimate.equivalent_poses for scan in scans])
    V, S = T_lidar_target.shape[:2]
    every_frame = np.tile(T_mocap_target[:, None], (V, 1, 1, 1))
    every_scan = np.repeat(T_lidar_target, V, axis=0)
    best: tuple[float, Ints] = (np.inf, np.zeros((2, 0), dtype=np.int64))
    for i, j, k in product(range(V), range(V), range(S)):
        T_mocap_lidar = T_mocap_target[j] @ inverse(T_lidar_target[i, k])
        fit = np.minimum(distances(T_mocap_lidar, every_frame, every_scan)[0].reshape(V, V), CUT**2)
        pairs = np.array(linear_sum_assignment(fit))
        if (cost := float(fit[*pairs].sum())) < best[0]:
            best = cost, pairs[:, fit[*pairs] < CUT**2]
    if best[1].shape[1] < max(3, 0.75 * V):
        return ""
    return ", ".join(f"{scans[i].name} fits frame {scans[j].frame}" for i, j in best[1].T if i != j)


def _without(markers: Floats, k: int) -> Floats:
    return np.where(np.arange(len(markers))[:, None] == k, np.nan, markers)


def _fit(T_lidar_mocap: Floats, T_mocap_target: Floats, T_lidar_target: Floats) -> float:
    """Return the squared distance of a frame's pose of the target from a scan's equivalent ones (S, 4, 4)."""
    squared, *_ = distances(inverse(T_lidar_mocap), T_mocap_target[None, None], T_lidar_target[None])
    return float(squared[0])


def _same_place(a: MocapScan, b: MocapScan) -> bool:
    A, B = a.estimate.T_lidar_target, b.estimate.T_lidar_target
    apart = np.linalg.norm(A[:3, 3] - B[:3, 3])
    return bool(apart < SAME_PLACE[0] and angle(A[:3, :3].T @ B[:3, :3]) < SAME_PLACE[1])


def _listed(scans: Sequence[MocapScan], found: Consensus) -> str:
    parts = []
    for scan, agrees in zip(scans, found.inlier, strict=True):
        if not agrees:
            off = inverse(found.T_a_b)[:3] @ scan.T_mocap_target[:, 3] - scan.estimate.T_lidar_target[:3, 3]
            parts.append(f"{scan.name} is {np.linalg.norm(off):.2f} m off")
    return "; ".join(parts)
