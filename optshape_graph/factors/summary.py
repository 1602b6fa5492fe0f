"""Summary factors: a measurement between a landmark and a LiDAR pose, as a compiled Between factor.

At H_0 the measurement's Gauss-Newton model is 1/2 ||R xi + d||^2, R (6, 6) triangular, in the right perturbation xi of
H_0. Its minimum xi* = -R^-1 d gives the measured pose H_hat = H_0 Exp(xi*). A Between factor's residual is
S Log(H_hat^-1 H), whose derivative at H_0 is S J_r^-1(-xi*) with SE(3)'s right Jacobian J_r: so S = R J_r(-xi*) makes
its residual and its Jacobian at H_0 those of the measurement. A Gauss-Newton step from H_0 is then the exact one, and
a solution at which the summaries made there leave no step is a solution of the exact factors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats
from optshape_graph.factors._noise import gaussian
from optshape_graph.factors.measurement import TemplateMeasurement
from optshape_graph.factors.se3 import adjoint, inverse, vec, vec_derivative

RANK_TOLERANCE = 1e-9
"""Ratio of a diagonal entry of R to the largest, below which that direction counts as not measured."""

FARTHEST_RAD = 1.0
"""Rotation between H_0 and H_hat beyond which a summary is made at the measurement's own pose instead: the
linearisation reaches no further."""


@dataclass(frozen=True, eq=False)
class Summary:
    """A measured pose with its square root information.

    Attributes:
        T_target_lidar: (4, 4) measured pose H_hat.
        sqrt_information: (6, 6) S: the residual is S Log(H_hat^-1 H), rotation first.
        floor: the part of the measurement's error that no pose takes away, to first order.
    """

    T_target_lidar: Floats
    sqrt_information: Floats
    floor: float

    def factor(
        self, k_target: int, k_lidar: int, loss: gtsam.noiseModel.mEstimator.Base | None = None
    ) -> gtsam.BetweenFactorPose3:
        """Return the factor between T_world_target and T_world_lidar; see `SummaryFactor`."""
        return gtsam.BetweenFactorPose3(
            k_target, k_lidar, gtsam.Pose3(self.T_target_lidar), gaussian(self.sqrt_information, loss)
        )

    def landmark_factor(
        self, k_target: int, T_world_lidar: ArrayLike, loss: gtsam.noiseModel.mEstimator.Base | None = None
    ) -> gtsam.PriorFactorPose3:
        """Return the factor on T_world_target, the LiDAR pose being known; see `LandmarkFactor`.

        The measured landmark is X_hat = T_world_lidar H_hat^-1, and Log(X_hat^-1 X) = -Ad(H_hat) Log(H_hat^-1 H): the
        square root information is S Ad(H_hat^-1).
        """
        T_lidar_target = inverse(self.T_target_lidar)
        measured = gtsam.Pose3(np.asarray(T_world_lidar, float) @ T_lidar_target)
        return gtsam.PriorFactorPose3(
            k_target, measured, gaussian(self.sqrt_information @ adjoint(T_lidar_target), loss)
        )


def summarise(measurements: Sequence[TemplateMeasurement], T_target_lidar: ArrayLike | None = None) -> list[Summary]:
    """Summarise measurements, all at once.

    Args:
        measurements: m measurements.
        T_target_lidar: (m, 4, 4) poses H_0; None: where each measurement was taken.
    """
    if not measurements:
        return []
    own = np.stack([m.T_target_lidar for m in measurements])
    H = own if T_target_lidar is None else np.asarray(T_target_lidar, float)
    L = np.stack([m.L for m in measurements])
    b = np.stack([m.b for m in measurements])
    R, xi, floor = _gauss_newton(L, b, H)
    far = ~(np.linalg.norm(xi[:, :3], axis=1) < FARTHEST_RAD)
    if far.any():
        H = np.where(far[:, None, None], own, H)
        R, xi, floor = _gauss_newton(L, b, H)
    return [
        Summary(
            T @ gtsam.Pose3.Expmap(step).matrix(),
            root @ gtsam.Pose3.ExpmapDerivative(-step),
            float(least) + 0.5 * m.c**2,
        )
        for m, T, root, step, least in zip(measurements, H, R, xi, floor, strict=True)
    ]


def SummaryFactor(
    measurement: TemplateMeasurement,
    k_target: int,
    k_lidar: int,
    T_target_lidar: ArrayLike | None = None,
    loss: gtsam.noiseModel.mEstimator.Base | None = None,
) -> gtsam.BetweenFactorPose3:
    """Return the compiled, serialisable factor between T_world_target and T_world_lidar.

    Args:
        measurement: of T_target_lidar = T_world_target^-1 T_world_lidar.
        k_target: key of T_world_target.
        k_lidar: key of T_world_lidar.
        T_target_lidar: (4, 4) pose to summarise at; None: where the measurement was taken.
        loss: robust loss on the distance from the measured pose (6 degrees of freedom); None: least squares.
    """
    return _summary(measurement, T_target_lidar).factor(k_target, k_lidar, loss)


def LandmarkFactor(
    measurement: TemplateMeasurement,
    k_target: int,
    T_world_lidar: ArrayLike,
    T_target_lidar: ArrayLike | None = None,
    loss: gtsam.noiseModel.mEstimator.Base | None = None,
) -> gtsam.PriorFactorPose3:
    """Return the compiled, serialisable factor on T_world_target alone, the LiDAR pose being known.

    Args:
        measurement: of T_target_lidar.
        k_target: key of T_world_target.
        T_world_lidar: (4, 4) known LiDAR pose.
        T_target_lidar: (4, 4) pose to summarise at; None: where the measurement was taken.
        loss: robust loss on the distance from the measured pose; None: least squares.
    """
    return _summary(measurement, T_target_lidar).landmark_factor(k_target, T_world_lidar, loss)


def _summary(measurement: TemplateMeasurement, T_target_lidar: ArrayLike | None) -> Summary:
    at = None if T_target_lidar is None else np.asarray(T_target_lidar, float)[None]
    return summarise([measurement], at)[0]


def _gauss_newton(L: Floats, b: Floats, H: Floats) -> tuple[Floats, Floats, Floats]:
    """Return R (m, 6, 6), the minimum xi (m, 6) of 1/2 ||L z + b||^2 linearised at H, and its value there (m,)."""
    J = L @ vec_derivative(H)
    e = np.einsum("mij,mj->mi", L, vec(H)) + b
    factor = np.asarray(np.linalg.qr(np.concatenate([J, e[..., None]], axis=-1), mode="r"))
    R, d, rest = factor[:, :6, :6].copy(), factor[:, :6, 6:], factor[:, 6, 6]
    diagonal = np.abs(np.einsum("mii->mi", R))
    full = diagonal.min(axis=1) > RANK_TOLERANCE * diagonal.max(axis=1)
    xi = np.zeros(d.shape)
    xi[full] = -np.linalg.solve(R[full], d[full])
    if not full.all():
        xi[~full] = -np.linalg.pinv(R[~full], rcond=RANK_TOLERANCE) @ d[~full]
    floor = 0.5 * (np.square(R @ xi + d).sum(axis=(1, 2)) + rest**2)
    return R, xi[..., 0], floor
