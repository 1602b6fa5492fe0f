"""Errors of poses, by the paper's formulas and against their covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.se3 import angle, apply, inverse, inverse_covariance, log, skew
from optshape_graph.target import Target


@dataclass(frozen=True)
class PoseError:
    """Errors of one estimate, modulo the target's symmetry (Huang, Clark and Grizzle, Section VI).

    Attributes:
        rmse: root mean square distance of the vertices from the true ones, metres.
        e_t: distance between the target origins, metres.
        e_r: angle between the rotations, rad.
        distance: of the true vertex mean from the sensor, metres; percentages are relative to it.
    """

    rmse: float
    e_t: float
    e_r: float
    distance: float

    @property
    def rmse_pct(self) -> float:
        """RMSE in percent of the distance."""
        return 100.0 * self.rmse / self.distance

    @property
    def e_t_pct(self) -> float:
        """Translation error in percent of the distance."""
        return 100.0 * self.e_t / self.distance


def pose_error(target: Target, T_estimated: Floats, T_true: Floats) -> PoseError:
    """Compare two poses T_lidar_target, (4, 4) each: RMSE, e_t = |t - t~|, e_r = |Log(R R~^T)|.

    Of the poses that are equivalent to the estimate by the target's symmetry, the nearest counts.
    """
    nearest = target.nearest_equivalent(T_estimated, T_true)
    difference = apply(nearest, target.vertices) - apply(T_true, target.vertices)
    return PoseError(
        rmse=float(np.sqrt((difference**2).sum(axis=1).mean())),
        e_t=float(np.linalg.norm(T_true[:3, 3] - nearest[:3, 3])),
        e_r=float(angle(inverse(nearest) @ T_true)),
        distance=float(np.linalg.norm(T_true[:3, 3])),
    )


def quantisation_error(azimuth_step: float, distance: float) -> float:
    """Return e_q, the distance, metres, of adjacent points of a ring at a distance, metres; the step is in rad."""
    return azimuth_step * distance


@dataclass(frozen=True, eq=False, repr=False)
class NormalisedError(Value):
    """A pose error in the target's tangent space, against its covariance.

    Attributes:
        xi: (6,) Log(T_estimated^-1 T_true): rotation first, rad and metres, target frame.
        sigma: (6,) standard deviations that the estimate states.
        nees: xi^T covariance^-1 xi; chi-square with 6 degrees of freedom, if the covariance is right.
        vertex_nees: (n,) the same of each vertex, with 3 degrees of freedom.
    """

    xi: Floats
    sigma: Floats
    nees: float
    vertex_nees: Floats

    def __post_init__(self) -> None:
        for field in ("xi", "sigma", "vertex_nees"):
            object.__setattr__(self, field, frozen(getattr(self, field)))


def normalised_error(target: Target, T_estimated: Floats, covariance: Floats, T_true: Floats) -> NormalisedError:
    """Compare a pose error with its stated covariance, modulo the target's symmetry.

    Args:
        target: the target.
        T_estimated: (4, 4) T_lidar_target.
        covariance: (6, 6) of its right perturbation, rotation first.
        T_true: (4, 4) T_lidar_target.

    A symmetry S turns the covariance with the pose: Ad(S^-1) C Ad(S^-1)^T is that of T S.
    """
    nearest = target.nearest_equivalent(T_estimated, T_true)
    covariance = inverse_covariance(inverse(nearest) @ T_estimated, covariance)
    # In the estimated target frame: the true vertex against the template's.
    T_estimated_true = inverse(nearest) @ T_true
    xi = log(T_estimated_true)
    offset = apply(T_estimated_true, target.vertices) - target.vertices
    J = vertex_jacobian(target)
    return NormalisedError(
        xi=xi,
        sigma=np.sqrt(np.diag(covariance)),
        nees=float(xi @ np.linalg.solve(covariance, xi)),
        vertex_nees=np.array([d @ np.linalg.solve(j @ covariance @ j.T, d) for d, j in zip(offset, J, strict=True)]),
    )


def vertex_jacobian(target: Target) -> Floats:
    """Return the derivative (n, 3, 6) of the vertices v, metres, target frame: omega x v + u by (omega, u)."""
    return np.concatenate([-skew(target.vertices), np.broadcast_to(np.eye(3), (len(target), 3, 3))], axis=2)
