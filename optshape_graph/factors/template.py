"""Exact GTSAM factors: of a template measurement, compiled or as the callback it is tested against; of single points.

Single points are for robust losses and graduated non-convexity: a loss weighs a factor as a whole.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats
from optshape_graph.factors._callback import CheckedFactor, relative_pose
from optshape_graph.factors._rows import checked, checked_keys, gaussian
from optshape_graph.factors.measurement import Measured, TemplateMeasurement, measurement_of
from optshape_graph.se3 import PoseLike, as_transform, vec, vec_derivative

# Where z and the constant 1 sit in vec of the 4 x 4 matrix, column-major.
_Z = np.array([0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14])
_ONE = 15

ALONG = 1e-4
"""Square root information along what a point does not measure, 1/m: GNC's weights break silently without any,
and at this one a metre adds 5e-9 to the cost."""


def TemplateFactor(
    measurement: TemplateMeasurement | Measured,
    key: int,
    T_target_a: PoseLike | None = None,
    T_b_lidar: PoseLike | None = None,
) -> gtsam.FrobeniusPriorPose3:
    """Return the exact point-to-line factor of a measurement, compiled: no callback, whatever the number of points.

    A Frobenius prior's residual is S (vec T - vec M), linear in the 16 entries of T. With M = 0 the last of them,
    which is 1, carries the constants: S [z; 1] = [L z + b; c], so the factor's error is the measurement's own.

    Args:
        measurement: of T_target_lidar, or an estimate.
        key: of the pose T_a_b with T_target_lidar = T_target_a T_a_b T_b_lidar; of T_target_lidar itself when
            neither transform is given. So a LiDAR pose facing a known target, T_world_lidar, takes
            T_target_a = T_target_world; an extrinsic takes what is on both of its sides.
        T_target_a: (4, 4) known transform on the left; None: the identity.
        T_b_lidar: (4, 4) known transform on the right; None: the identity.

    Raises:
        InputError: neither a measurement nor an estimate, an estimate that failed, a key that is none, or a transform
            that is none.
    """
    checked_keys(key)
    measurement = measurement_of(measurement)
    if T_target_a is not None or T_b_lidar is not None:
        left, right = (
            np.eye(4) if T is None else as_transform(T, name)
            for name, T in (("T_target_a", T_target_a), ("T_b_lidar", T_b_lidar))
        )
        measurement = measurement.substituted(left, right)
    S = np.zeros((16, 16))
    S[:12, _Z] = measurement.L
    S[:12, _ONE] = measurement.b
    S[12, _ONE] = measurement.c
    return gtsam.FrobeniusPriorPose3(key, np.zeros((4, 4)), gaussian(S))


def TemplateCallbackFactor(measurement: TemplateMeasurement | Measured, *keys: int) -> gtsam.CustomFactor:
    """Return the exact factor as a Python callback: the reference, and the exact factor between two poses.

    It costs a copy of all values in each evaluation by GTSAM's optimisers: `SummaryFactor` is what large graphs take.

    Args:
        measurement: of T_target_lidar, or an estimate.
        keys: that of T_target_lidar, or those of T_world_target and T_world_lidar.

    Raises:
        InputError: neither a measurement nor an estimate, an estimate that failed, or keys that are none or the same.
    """
    exact = measurement_of(measurement)

    def evaluate(values: gtsam.Values) -> tuple[Floats, list[Floats]]:
        H, derivatives = relative_pose(values, keys)
        residual = np.append(exact.L @ vec(H) + exact.b, exact.c)
        J = np.vstack([exact.L @ vec_derivative(H), np.zeros(6)])
        return residual, [J @ derivative for derivative in derivatives]

    return CheckedFactor(evaluate, 13, keys, [6] * len(keys))


def PointToEdgeFactor(
    point: ArrayLike,
    normal: ArrayLike,
    offset: float,
    key: int,
    sigma: float,
    plane_sigma: float | None = None,
    loss: gtsam.noiseModel.mEstimator.Base | None = None,
) -> gtsam.KnownLandmarkFactor2Pose3:
    """Return the compiled factor of one edge point on T_target_lidar: n . (R p + t) - c, and e_x . (R p + t).

    Args:
        point: (3,) edge point, metres, LiDAR frame.
        normal: (2,) outward unit normal of its edge, (y, z) of the target frame.
        offset: offset of its edge, metres.
        key: of T_target_lidar.
        sigma: standard deviation across the edge, metres.
        plane_sigma: standard deviation across the plane, metres; None: the point says nothing about the plane.
        loss: robust loss on the point as a whole; None: least squares.
    """
    checked_keys(key)
    n = np.append(0.0, checked("normal", normal, (2,)))
    foot, along = offset * n, np.cross([1.0, 0.0, 0.0], n)
    across_plane = ALONG if plane_sigma is None else 1.0 / plane_sigma
    S = np.stack([n / sigma, across_plane * np.array([1.0, 0.0, 0.0]), ALONG * along])
    return gtsam.KnownLandmarkFactor2Pose3(key, checked("point", point, (3,)), foot, gaussian(S, loss))


def PointToPlaneFactor(
    point: ArrayLike, key: int, sigma: float, loss: gtsam.noiseModel.mEstimator.Base | None = None
) -> gtsam.KnownLandmarkFactor2Pose3:
    """Return the compiled factor of one return of the target on T_target_lidar: e_x . (R p + t).

    Args:
        point: (3,) return, metres, LiDAR frame.
        key: of T_target_lidar.
        sigma: standard deviation across the plane, metres.
        loss: robust loss; None: least squares.
    """
    checked_keys(key)
    S = np.diag([1.0 / sigma, ALONG, ALONG])
    return gtsam.KnownLandmarkFactor2Pose3(key, checked("point", point, (3,)), np.zeros(3), gaussian(S, loss))
