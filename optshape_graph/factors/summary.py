"""Summary factors: a measurement between a landmark and a LiDAR pose, as a compiled Between factor.

At H_0 the measurement's Gauss-Newton model is 1/2 ||R xi + d||^2, R (6, 6) triangular, in the right perturbation xi of
H_0. Its minimum xi* = -R^-1 d gives the measured pose H_hat = H_0 Exp(xi*). A Between factor's residual is
S Log(H_hat^-1 H), whose derivative at H_0 is S J_r^-1(-xi*) with SE(3)'s right Jacobian J_r: so S = R J_r(-xi*) makes
its residual and its Jacobian at H_0 those of the measurement. A Gauss-Newton step from H_0 is then the exact one, and
a solution at which the summaries made there leave no step is a solution of the exact factors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats, Value
from optshape_graph.factors._rows import checked_keys, factored, gaussian
from optshape_graph.factors.measurement import Measured, TemplateMeasurement, measurement_of
from optshape_graph.se3 import PoseLike, adjoint, as_matrix, as_transform, inverse, vec, vec_derivative

RANK_TOLERANCE = 1e-9
"""Ratio of a diagonal entry of R to the largest, below which that direction counts as not measured."""

FARTHEST_RAD = 1.0
"""Rotation between H_0 and H_hat beyond which a summary is made at the measurement's own pose instead: the
linearisation reaches no further."""


@dataclass(frozen=True, eq=False, slots=True)
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

    @property
    def is_finite(self) -> bool:
        """Whether its factor has a residual and a derivative everywhere."""
        return math.isfinite(np.vdot(self.sqrt_information, self.sqrt_information) + self.T_target_lidar.sum())

    def factor(
        self, k_target: int, k_lidar: int, loss: gtsam.noiseModel.mEstimator.Base | None = None
    ) -> gtsam.BetweenFactorPose3:
        """Return the factor between T_world_target and T_world_lidar; see `SummaryFactor`."""
        return gtsam.BetweenFactorPose3(
            k_target, k_lidar, gtsam.Pose3(self.T_target_lidar), gaussian(self.sqrt_information, loss)
        )

    def landmark_factor(
        self, k_target: int, T_world_lidar: PoseLike, loss: gtsam.noiseModel.mEstimator.Base | None = None
    ) -> gtsam.PriorFactorPose3:
        """Return the factor on T_world_target, the LiDAR pose being known; see `LandmarkFactor`.

        The measured landmark is X_hat = T_world_lidar H_hat^-1, and Log(X_hat^-1 X) = -Ad(H_hat) Log(H_hat^-1 H): the
        square root information is S Ad(H_hat^-1).
        """
        T_lidar_target = inverse(self.T_target_lidar)
        measured = gtsam.Pose3(as_matrix(T_world_lidar) @ T_lidar_target)
        return gtsam.PriorFactorPose3(
            k_target, measured, gaussian(self.sqrt_information @ adjoint(T_lidar_target), loss)
        )


@dataclass(frozen=True, eq=False, repr=False)
class Linearised(Value):
    """Gauss-Newton models 1/2 ||R xi + d||^2 + floor of m measurements, xi the right perturbation of T_target_lidar.

    Attributes:
        measurements: that they are of.
        T_target_lidar: (m, 4, 4) H_0, where they are linearised.
        R: (m, 6, 6) upper triangular: the whitened derivative.
        xi: (m, 6) their minima; d = -R xi, the whitened residual at H_0.
        floor: (m,) what no pose takes away, to first order, the measurement's own constant apart.
    """

    measurements: Sequence[TemplateMeasurement]
    T_target_lidar: Floats
    R: Floats
    xi: Floats
    floor: Floats

    @property
    def residuals(self) -> Floats:
        """(m, 6) d, whitened, at H_0."""
        return np.asarray(-(self.R @ self.xi[..., None])[..., 0])

    def summaries(self) -> list[Summary]:
        """Return the measured poses; of measurements whose minimum is too far away, as linearised at their own pose."""
        far = ~(np.square(self.xi[:, :3]).sum(axis=1) < FARTHEST_RAD**2)
        if far.any():
            own = np.stack([m.T_target_lidar for m in self.measurements])
            H = np.where(far[:, None, None], own, self.T_target_lidar)
            nearer = linearise(self.measurements, H)
        else:
            nearer = self
        return [
            Summary(
                T @ gtsam.Pose3.Expmap(step).matrix(),
                root @ gtsam.Pose3.ExpmapDerivative(-step),
                float(least) + 0.5 * m.c**2,
            )
            for m, T, root, step, least in zip(
                self.measurements, nearer.T_target_lidar, nearer.R, nearer.xi, nearer.floor, strict=True
            )
        ]


def linearise(measurements: Sequence[TemplateMeasurement], T_target_lidar: ArrayLike | None = None) -> Linearised:
    """Linearise measurements, all at once.

    Args:
        measurements: m measurements, one at least.
        T_target_lidar: (m, 4, 4) poses H_0; None: where each measurement was taken.
    """
    H = np.array([m.T_target_lidar for m in measurements] if T_target_lidar is None else T_target_lidar, float)
    L, b = np.array([m.L for m in measurements]), np.array([m.b for m in measurements])
    return Linearised(measurements, H, *_gauss_newton(L, b, H))


def summarise(measurements: Sequence[TemplateMeasurement], T_target_lidar: ArrayLike | None = None) -> list[Summary]:
    """Summarise measurements, all at once.

    Args:
        measurements: m measurements.
        T_target_lidar: (m, 4, 4) poses H_0; None: where each measurement was taken.
    """
    return linearise(measurements, T_target_lidar).summaries() if measurements else []


def SummaryFactor(
    measurement: TemplateMeasurement | Measured,
    k_target: int,
    k_lidar: int,
    T_target_lidar: PoseLike | None = None,
    loss: gtsam.noiseModel.mEstimator.Base | None = None,
) -> gtsam.BetweenFactorPose3:
    """Return the compiled, serialisable factor between T_world_target and T_world_lidar.

    Args:
        measurement: of T_target_lidar = T_world_target^-1 T_world_lidar, or an estimate.
        k_target: key of T_world_target.
        k_lidar: key of T_world_lidar.
        T_target_lidar: (4, 4) pose to summarise at; None: where the measurement was taken.
        loss: robust loss on the distance from the measured pose (6 degrees of freedom); None: least squares.

    Raises:
        InputError: neither a measurement nor an estimate, an estimate that failed, keys that are none or the same, or
            a pose that is none.
    """
    checked_keys(k_target, k_lidar)
    return _summary(measurement, T_target_lidar).factor(k_target, k_lidar, loss)


def LandmarkFactor(
    measurement: TemplateMeasurement | Measured,
    k_target: int,
    T_world_lidar: PoseLike,
    T_target_lidar: PoseLike | None = None,
    loss: gtsam.noiseModel.mEstimator.Base | None = None,
) -> gtsam.PriorFactorPose3:
    """Return the compiled, serialisable factor on T_world_target alone, the LiDAR pose being known.

    Args:
        measurement: of T_target_lidar, or an estimate.
        k_target: key of T_world_target.
        T_world_lidar: (4, 4) known LiDAR pose.
        T_target_lidar: (4, 4) pose to summarise at; None: where the measurement was taken.
        loss: robust loss on the distance from the measured pose; None: least squares.

    Raises:
        InputError: neither a measurement nor an estimate, an estimate that failed, a key that is none, or a pose that
            is none.
    """
    checked_keys(k_target)
    return _summary(measurement, T_target_lidar).landmark_factor(
        k_target, as_transform(T_world_lidar, "T_world_lidar"), loss
    )


def _summary(measurement: TemplateMeasurement | Measured, T_target_lidar: PoseLike | None) -> Summary:
    at = None if T_target_lidar is None else as_transform(T_target_lidar, "T_target_lidar")[None]
    return summarise([measurement_of(measurement)], at)[0]


def _gauss_newton(L: Floats, b: Floats, H: Floats) -> tuple[Floats, Floats, Floats]:
    """Return R (m, 6, 6), the minimum xi (m, 6) of 1/2 ||L z + b||^2 linearised at H, and its value there (m,)."""
    rows = np.empty((*b.shape, 7))
    np.matmul(L, vec_derivative(H), out=rows[..., :6])
    rows[..., 6] = (L @ vec(H)[..., None])[..., 0] + b
    factor = factored(rows)
    R, d, rest = factor[:, :6, :6], factor[:, :6, 6:], factor[:, 6, 6]
    diagonal = np.abs(factor.diagonal(axis1=1, axis2=2)[:, :6])
    full = diagonal.min(axis=1) > RANK_TOLERANCE * diagonal.max(axis=1)
    if full.all():
        return R, np.asarray(-np.linalg.solve(R, d)[..., 0]), 0.5 * rest**2
    xi = np.zeros(d.shape)
    xi[full] = -np.linalg.solve(R[full], d[full])
    xi[~full] = -np.linalg.pinv(R[~full], rcond=RANK_TOLERANCE) @ d[~full]
    return R, xi[..., 0], 0.5 * (np.square(R @ xi + d).sum(axis=(1, 2)) + rest**2)
