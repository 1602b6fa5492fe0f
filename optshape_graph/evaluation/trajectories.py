"""Errors of maps and trajectories: absolute and relative trajectory error, landmark error, consistency.

Absolute errors are distances after one rigid alignment of all positions (Sturm et al., A benchmark for the evaluation
of RGB-D SLAM systems, IROS 2012). Relative errors are those of the motion over a distance (Geiger et al., CVPR 2012).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.errors import InputError
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.mapping.map import Map
from optshape_graph.se3 import angle, difference, inverse, inverse_covariance, transform
from optshape_graph.target import Target


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of errors, metres or rad.

    Attributes:
        rmse: root of the mean square.
        mean: mean.
        median: median.
        largest: maximum.
        count: number of errors.
    """

    rmse: float
    mean: float
    median: float
    largest: float
    count: int

    @classmethod
    def of(cls, errors: Floats) -> ErrorStatistics:
        """Summarise errors (N,), in any unit.

        Raises:
            InputError: there are none.
        """
        if not len(errors):
            raise InputError("no errors to summarise: the trajectories have no poses in common")
        return cls(
            float(np.sqrt(np.mean(np.square(errors)))), float(errors.mean()), float(np.median(errors)),
            float(errors.max()), len(errors),
        )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class AbsoluteError(Value):
    """Errors of a trajectory as a whole.

    Attributes:
        translation: distance between positions, metres.
        rotation: angle between orientations, rad.
        T_true_estimated: (4, 4) alignment that was applied.
        distances: (N,) metres.
    """

    translation: ErrorStatistics
    rotation: ErrorStatistics
    T_true_estimated: Floats
    distances: Floats


@dataclass(frozen=True, eq=False, repr=False)
class RelativeError(Value):
    """Errors of the motion over a distance.

    Attributes:
        over: that distance, metres.
        translation: metres.
        rotation: rad.
    """

    over: float
    translation: ErrorStatistics
    rotation: ErrorStatistics


def associate(estimated: Trajectory, true: Trajectory, tolerance: float = 0.02) -> tuple[Floats, Floats]:
    """Return the poses (N, 4, 4) of both trajectories whose stamps are nearest to each other.

    Args:
        estimated: with stamps.
        true: with stamps.
        tolerance: largest difference of stamps, seconds.

    Raises:
        InputError: a trajectory without stamps, or no stamps that agree.
    """
    if estimated.stamps is None or true.stamps is None:
        raise InputError("trajectories are matched by their stamps, and one of them has none")
    if not len(true) or not len(estimated):
        raise InputError("a trajectory without poses")
    nearest = _nearest(true.stamps, estimated.stamps)
    close = np.abs(true.stamps[nearest] - estimated.stamps) <= tolerance
    if not close.any():
        raise InputError(f"no stamps of {estimated.name} and {true.name} are within {tolerance} s of each other")
    return estimated.poses[close], true.poses[nearest[close]]


def align(estimated: Floats, true: Floats) -> Floats:
    """Return T_true_estimated (4, 4), the rigid transform that brings positions nearest (Umeyama, TPAMI 1991).

    If the positions are on a line, which leaves the turn about it free, orientations decide.

    Args:
        estimated: (N, 4, 4) poses.
        true: (N, 4, 4) poses.
    """
    a, b = estimated[:, :3, 3], true[:, :3, 3]
    covariance = (b - b.mean(axis=0)).T @ (a - a.mean(axis=0))
    spread = np.linalg.svd(a - a.mean(axis=0), compute_uv=False)
    if len(a) < 3 or spread[1] < 1e-6 * max(spread[0], 1e-12):
        covariance = np.einsum("nij,nkj->ik", true[:, :3, :3], estimated[:, :3, :3])
    U, _, Vt = np.linalg.svd(covariance)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return transform(R, b.mean(axis=0) - R @ a.mean(axis=0))


def absolute_error(estimated: Floats, true: Floats, aligned: bool = True) -> AbsoluteError:
    """Compare poses (N, 4, 4) with the true ones, after the best rigid alignment or as they are.

    Raises:
        InputError: no poses, or another number of them than of true ones.
    """
    _check(estimated, true)
    T = align(estimated, true) if aligned else np.eye(4)
    apart = inverse(true) @ (T @ estimated)
    distances = np.linalg.norm(apart[:, :3, 3], axis=1)
    return AbsoluteError(ErrorStatistics.of(distances), ErrorStatistics.of(angle(apart)), T, distances)


def relative_error(estimated: Floats, true: Floats, over: float) -> RelativeError:
    """Compare motions over a distance along the true path.

    Args:
        estimated: (N, 4, 4) poses.
        true: (N, 4, 4) poses.
        over: metres.

    Raises:
        InputError: the path is shorter than `over`.
    """
    _check(estimated, true)
    if not over > 0:
        raise InputError(f"a relative error over {over} m; expected a distance above 0")
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1))])
    end = np.searchsorted(gone, gone + over)
    start = np.flatnonzero(end < len(gone))
    if not len(start):
        raise InputError(f"the path is {gone[-1]:.3g} m long, shorter than the {over:g} m asked for")
    end = end[start]
    motion = inverse(inverse(true[start]) @ true[end]) @ (inverse(estimated[start]) @ estimated[end])
    distances = np.linalg.norm(motion[:, :3, 3], axis=1)
    return RelativeError(over, ErrorStatistics.of(distances), ErrorStatistics.of(angle(motion)))


@dataclass(frozen=True)
class LandmarkError:
    """Error of one landmark, modulo its template's symmetry.

    Attributes:
        id: its name.
        position: metres.
        rotation: rad.
        nees: normalised error squared, 6 degrees of freedom.
    """

    id: str
    position: float
    rotation: float
    nees: float


def landmark_errors(
    estimated: Map, true: Mapping[str, tuple[Target, Floats]], T_true_estimated: Floats | None = None
) -> tuple[LandmarkError, ...]:
    """Compare the landmarks of a map with the true ones of the same names.

    Args:
        estimated: the map.
        true: template and T_world_target (4, 4) by name.
        T_true_estimated: (4, 4) of the map's world in the true one; None: they are the same.
    """
    T = np.eye(4) if T_true_estimated is None else T_true_estimated
    errors = []
    for landmark in estimated.landmarks:
        if landmark.id not in true:
            continue
        target, T_true = true[landmark.id]
        moved = T @ landmark.T_world_target
        equivalent = target.nearest_equivalent(moved, T_true)
        xi = difference(equivalent, T_true)
        covariance = inverse_covariance(inverse(equivalent) @ moved, landmark.covariance)
        nees = float(xi @ np.linalg.solve(covariance, xi))
        apart = float(np.linalg.norm(moved[:3, 3] - T_true[:3, 3]))
        errors.append(LandmarkError(landmark.id, apart, float(np.linalg.norm(xi[:3])), nees))
    return tuple(errors)


@dataclass(frozen=True)
class Consistency:
    """Normalised errors squared against chi-square.

    Attributes:
        per_dof: their mean over the degrees of freedom; 1, if covariances are right.
        low, high: 95 % interval of `per_dof`, if covariances are right and errors independent.
        count: number of errors.
    """

    per_dof: float
    low: float
    high: float
    count: int


def pose_nees(estimated: Floats, true: Floats, covariance: Floats) -> Floats:
    """Return the normalised errors squared (N,) of poses (N, 4, 4) with covariances (N, 6, 6), right perturbations.

    Raises:
        InputError: no poses, or another number of them than of true ones.
    """
    _check(estimated, true)
    xi = difference(estimated, true)
    return np.asarray(np.einsum("ni,ni->n", xi, np.linalg.solve(covariance, xi[..., None])[..., 0]))


def consistency_of(nees: Floats, dof: int = 6) -> Consistency:
    """Summarise normalised errors squared (N,) of some degrees of freedom each.

    Raises:
        InputError: there are none.
    """
    n = len(nees)
    if not n:
        raise InputError("no normalised errors to summarise")
    low, high = (float(chi2.ppf(p, dof * n) / (dof * n)) for p in (0.025, 0.975))
    return Consistency(float(np.mean(nees) / dof), low, high, n)


def predicted_rmse(covariance: Floats) -> float:
    """Return the root mean square position error, metres, that covariances (N, 6, 6) of poses predict."""
    trace = np.einsum("nii->n", covariance[:, 3:, 3:])  # a rotation of the frame does not change it
    return float(np.sqrt(trace.mean()))


def _check(estimated: Floats, true: Floats) -> None:
    if estimated.shape != true.shape or estimated.ndim != 3 or not len(estimated):
        raise InputError(f"expected as many estimated as true poses, found {estimated.shape} and {true.shape}")


def _nearest(values: Floats, wanted: Floats) -> Ints:
    right = np.searchsorted(values, wanted).clip(1, max(len(values) - 1, 1))
    right = np.minimum(right, len(values) - 1)
    left = np.maximum(right - 1, 0)
    return np.asarray(np.where(wanted - values[left] <= values[right] - wanted, left, right))
