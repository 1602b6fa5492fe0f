"""Pose estimates against motion capture: what the errors are when the frames are tied by other scans.

The markers are near the vertices, not on them, and the motion-capture frame is unknown to the LiDAR. So the template is
fitted rigidly to each scan's markers, and one rigid transform between the frames is fitted to the vertices of several
scans. Fitted to all scans but the one in question, it gives the leave-one-out errors; fitted to all, the
in-sample ones, which an estimator flatters itself with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.errors import InputError
from optshape_graph.pose import PoseEstimate
from optshape_graph.scan import Scan
from optshape_graph.se3 import angle, apply, inverse
from optshape_graph.target import Target

MIN_MARKERS = 3
"""Markers that a scan needs for the template to be fitted to them."""


@dataclass(frozen=True, eq=False, repr=False)
class MocapScan(Value):
    """One scan with its markers.

    Attributes:
        name: what results call it.
        estimate: of the target's pose from the LiDAR returns.
        markers: (n, 3) position of the marker near each vertex, metres, motion-capture frame; NaN where not seen.
        frame: the markers' frame.
        returns: on the target, where they are still needed.
    """

    name: str
    estimate: PoseEstimate
    markers: Floats
    frame: int = 0
    returns: Scan | None = None

    @property
    def T_mocap_target(self) -> Floats:
        """(4, 4) rigid fit of the template's vertices to the markers."""
        return fit_template(self.estimate.target, self.markers, self.name)


@dataclass(frozen=True)
class ScanError:
    """Errors of one scan's estimate.

    Attributes:
        scan: its name.
        rmse_m: root mean square distance of the vertices, metres (the paper's equation for RMSE).
        e_t_m: distance of the target origins, metres.
        e_r_deg: angle between the rotations, degrees.
    """

    scan: str
    rmse_m: float
    e_t_m: float
    e_r_deg: float


def align(to_points: Floats, from_points: Floats) -> Floats:
    """Return the rigid T_a_b (4, 4) that brings points of b (N, 3) nearest to points of a (N, 3), least squares.

    Raises:
        InputError: fewer than three points, or points on a line.
    """
    aligned = gtsam.Pose3.Align(np.asarray(to_points, float).T, np.asarray(from_points, float).T)
    spread = np.linalg.svd(from_points - from_points.mean(axis=0), compute_uv=False)
    if aligned is None or spread[1] < 1e-6 * max(float(spread[0]), 1e-300):
        raise InputError(f"{len(from_points)} points do not fix a rigid transform")
    return np.asarray(aligned.matrix())


def fit_template(target: Target, markers: Floats, name: str = "markers") -> Floats:
    """Return T_mocap_target (4, 4), the rigid fit of a template's vertices to the markers near them.

    Args:
        target: with n vertices.
        markers: (n, 3) metres, motion-capture frame, NaN where not seen.
        name: for messages.

    Raises:
        InputError: fewer than three markers seen, or markers on a line.
    """
    seen = np.isfinite(markers).all(axis=1)
    if seen.sum() < MIN_MARKERS:
        raise InputError(f"{name}: {int(seen.sum())} of {len(markers)} markers seen; expected at least {MIN_MARKERS}")
    return align(markers[seen], target.vertices[seen])


def assign_markers(target: Target, frames: Sequence[Floats]) -> tuple[int, ...]:
    """Find which marker is near which vertex, by shape: the assignment that fits the template best over all frames.

    Args:
        target: with n vertices.
        frames: (n, 3) positions of n markers in each frame, metres, the same markers in the same order; NaN: not seen.

    Returns:
        For each vertex, the marker's index.

    Raises:
        InputError: another number of markers than of vertices, no frame in which all are seen, or two assignments that
            fit alike, as of a symmetric target.
    """
    whole = [frame for frame in frames if np.isfinite(frame).all()]
    if not whole:
        raise InputError(f"no frame shows all {len(target)} markers, so they cannot be told apart by shape")
    if len(whole[0]) != len(target):
        raise InputError(
            f"{len(whole[0])} markers for {len(target)} vertices cannot be assigned by shape; name them in 'markers'"
        )

    def misfit(order: tuple[int, ...]) -> float:
        total = 0.0
        for frame in whole:
            T = align(frame[list(order)], target.vertices)
            total += float(np.sum((apply(T, target.vertices) - frame[list(order)]) ** 2))
        return total

    ranked = sorted((misfit(order), order) for order in permutations(range(len(target))))
    if ranked[1][0] < 2.0 * ranked[0][0] + 1e-9:
        raise InputError(
            f"target '{target.name}': two assignments of its markers fit alike; name the vertex of each in 'markers'"
        )
    return ranked[0][1]


def leave_one_out(scans: Sequence[MocapScan]) -> tuple[ScanError, ...]:
    """Compare each scan with its markers, the frames tied by all other scans.

    Of a symmetric target, each estimate is the equivalent one that is named as its markers are.

    Raises:
        InputError: fewer than two scans.
    """
    if len(scans) < 2:
        raise InputError(f"leave-one-out needs at least two scans with estimates and markers, found {len(scans)}")
    return tuple(_error(scan, tie([other for other in scans if other is not scan])) for scan in scans)


def in_sample(scans: Sequence[MocapScan]) -> tuple[ScanError, ...]:
    """Compare each scan with its markers, the frames tied by all scans, the compared one included."""
    return _compare(scans, tie(scans))


def tie(scans: Sequence[MocapScan]) -> Floats:
    """Return T_lidar_mocap (4, 4) that brings the vertices fitted to markers nearest to those of the estimates."""
    mocap = np.vstack([apply(scan.T_mocap_target, scan.estimate.target.vertices) for scan in scans])
    lidar = np.vstack([scan.estimate.vertices for scan in scans])
    return align(lidar, mocap)


def mean_error(errors: Sequence[ScanError]) -> ScanError:
    """Return the mean over scans, called "mean"."""
    return ScanError(
        "mean",
        float(np.mean([e.rmse_m for e in errors])),
        float(np.mean([e.e_t_m for e in errors])),
        float(np.mean([e.e_r_deg for e in errors])),
    )


def _compare(scans: Sequence[MocapScan], T_lidar_mocap: Floats) -> tuple[ScanError, ...]:
    return tuple(_error(scan, T_lidar_mocap) for scan in scans)


def _error(scan: MocapScan, T_lidar_mocap: Floats) -> ScanError:
    truth = T_lidar_mocap @ scan.T_mocap_target
    target = scan.estimate.target

    T = scan.estimate.T_lidar_target
    rmse = np.sqrt(np.mean(np.sum((scan.estimate.vertices - apply(truth, target.vertices)) ** 2, axis=1)))
    e_t = np.linalg.norm(T[:3, 3] - truth[:3, 3])
    return ScanError(scan.name, float(rmse), float(e_t), float(np.degrees(angle(inverse(truth) @ T))))
