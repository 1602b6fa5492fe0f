"""The measurement with scalar sensor parameters as unknowns: an inset along the rings, a range bias.

A parameter theta that moves points along known directions, p + theta q, adds theta n . (R q) to a residual: nine
columns, linear in theta vec R. The rows stay linear, now in

    [vec R; t; theta_1 vec R; ...; theta_k vec R; 1]   (22 columns for one parameter, 31 for two),

and compress exactly as those of the template measurement do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.factors._callback import CheckedFactor, relative_pose
from optshape_graph.factors._rows import checked, in_plane, outer_rows, triangular
from optshape_graph.factors.measurement import TemplateMeasurement
from optshape_graph.se3 import PoseLike, as_matrix, as_transform, vec, vec_derivative


def range_directions(points: ArrayLike) -> Floats:
    """Return the directions (N, 3) in which points (N, 3) move per metre of range bias: along their rays."""
    p = checked("points", points, (-1, 3))
    return np.asarray(p / np.linalg.norm(p, axis=1, keepdims=True))


def azimuth_directions(points: ArrayLike, outward: ArrayLike) -> Floats:
    """Return the directions (N, 3), metres per radian, in which edge points move along their rings.

    Args:
        points: (N, 3) edge points, metres, LiDAR frame, rings turning about z.
        outward: (N,) the number +1 where growing azimuth leads off the target, -1 where shrinking azimuth does.
    """
    p = checked("points", points, (-1, 3))
    sign = checked("outward", outward, (len(p),))
    return sign[:, None] * np.column_stack([-p[:, 1], p[:, 0], np.zeros(len(p))])


def edge_motion_rows(directions: ArrayLike, normals: ArrayLike) -> Floats:
    """Return the rows (N, 9) of n_k . (R q), what a unit of the parameter adds to `edge_rows`, unweighted.

    Args:
        directions: (N, 3) q, metres per unit of the parameter, LiDAR frame.
        normals: (N, 2) outward unit normal of each point's edge, (y, z) of the target frame.
    """
    q = checked("directions", directions, (-1, 3))
    return outer_rows(q, in_plane(checked("normals", normals, (len(q), 2))))


def plane_motion_rows(directions: ArrayLike) -> Floats:
    """Return the rows (N, 9) of e_x . (R q), what a unit of the parameter adds to `plane_rows`, unweighted."""
    q = checked("directions", directions, (-1, 3))
    return outer_rows(q, np.broadcast_to([1.0, 0.0, 0.0], q.shape))


@dataclass(frozen=True, eq=False, repr=False)
class AugmentedMeasurement(Value):
    """The cost 1/2 ||S [z; theta_1 vec R; ...; theta_k vec R; 1]||^2 of one target in one scan, exact.

    Attributes:
        stack: (n, n) S, upper triangular, n = 13 + 9 k; z = [vec R (column-major); t] of T_target_lidar.
        n_rows: number of scalar residuals it was made of.
        T_target_lidar: (4, 4) pose it was taken at.

    Raises:
        InputError: shapes that do not fit, or values that are not finite.
    """

    stack: Floats
    n_rows: int
    T_target_lidar: Floats

    def __post_init__(self) -> None:
        n = len(self.stack)
        if n < 13 or (n - 13) % 9:
            raise InputError(f"augmented measurement of {n} columns; expected 13 + 9 for each parameter")
        object.__setattr__(self, "stack", frozen(checked("augmented stack", self.stack, (n, n))))
        object.__setattr__(self, "T_target_lidar", as_transform(self.T_target_lidar, "T_target_lidar"))

    @classmethod
    def from_rows(
        cls, A: ArrayLike, motion: Sequence[ArrayLike], r: ArrayLike, T_target_lidar: PoseLike
    ) -> AugmentedMeasurement:
        """Compress whitened rows A z + sum_j theta_j B_j vec R + r.

        Args:
            A: (m, 12) whitened rows.
            motion: B_j (m, 9) for each parameter, whitened as A is.
            r: (m,) whitened constants.
            T_target_lidar: (4, 4) pose the measurement is taken at.
        """
        rows = checked("rows", A, (-1, 12))
        m = len(rows)
        blocks = [checked("motion rows", B, (m, 9)) for B in motion]
        stack = np.column_stack([rows, *blocks, checked("constants", r, (m,))])
        return cls(triangular(stack), m, as_matrix(T_target_lidar))

    @property
    def n_parameters(self) -> int:
        """Number of sensor parameters k."""
        return (len(self.stack) - 13) // 9

    def __add__(self, other: AugmentedMeasurement) -> AugmentedMeasurement:
        """Return the measurement of both scans, errors independent, taken at the pose of the first."""
        if not isinstance(other, AugmentedMeasurement):
            return NotImplemented
        if other.n_parameters != self.n_parameters:
            raise InputError(f"measurements with {self.n_parameters} and {other.n_parameters} parameters do not add")
        stack = triangular(np.vstack([self.stack, other.stack]))
        return AugmentedMeasurement(stack, self.n_rows + other.n_rows, self.T_target_lidar)

    def residual(self, T_target_lidar: PoseLike, theta: ArrayLike) -> Floats:
        """Return the residual (13 + 9 k,) at a pose (4, 4) and parameters (k,)."""
        z, parameters = vec(as_matrix(T_target_lidar)), checked("theta", theta, (self.n_parameters,))
        return np.asarray(self.stack @ np.concatenate([z, np.outer(parameters, z[:9]).ravel(), [1.0]]))

    def jacobians(self, T_target_lidar: PoseLike, theta: ArrayLike) -> tuple[Floats, Floats]:
        """Return the residual's derivatives by a right perturbation of the pose (., 6) and by theta (., k)."""
        H = as_matrix(T_target_lidar)
        parameters = checked("theta", theta, (self.n_parameters,))
        motion = self.stack[:, 12:-1].reshape(len(self.stack), self.n_parameters, 9)
        D = vec_derivative(H)
        by_pose = self.stack[:, :12] @ D + np.einsum("nkj,k->nj", motion, parameters) @ D[:9]
        return by_pose, motion @ vec(H)[:9]

    def error(self, T_target_lidar: PoseLike, theta: ArrayLike) -> float:
        """Return half the sum of the squared whitened rows, at a pose (4, 4) and parameters (k,)."""
        return 0.5 * float(np.square(self.residual(T_target_lidar, theta)).sum())

    def fixed(self, theta: ArrayLike) -> TemplateMeasurement:
        """Return the measurement that is left when the parameters (k,) are known."""
        parameters = checked("theta", theta, (self.n_parameters,))
        M = np.vstack([np.eye(12, 13), *(value * np.eye(9, 13) for value in parameters), np.eye(13)[12:]])
        return TemplateMeasurement.from_stack(self.stack @ M, self.n_rows, self.T_target_lidar)


def SensorParameterFactor(
    measurement: AugmentedMeasurement, k_pose: int | tuple[int, int], k_parameters: Sequence[int]
) -> gtsam.CustomFactor:
    """Return the exact factor on a pose and sensor parameters; no compiled factor is bilinear in the two.

    Args:
        measurement: with k parameters.
        k_pose: key of T_target_lidar, or keys of T_world_target and T_world_lidar.
        k_parameters: keys of the k parameters, each a `double` variable.

    Raises:
        InputError: another number of keys than of parameters, or keys that are none or the same.
    """
    poses = k_pose if isinstance(k_pose, tuple) else (k_pose,)
    if len(k_parameters) != measurement.n_parameters:
        raise InputError(f"{len(k_parameters)} keys for {measurement.n_parameters} sensor parameters")

    def evaluate(values: gtsam.Values) -> tuple[Floats, list[Floats]]:
        H, derivatives = relative_pose(values, poses)
        theta = np.array([values.atDouble(key) for key in k_parameters])
        by_pose, by_theta = measurement.jacobians(H, theta)
        jacobians = [by_pose @ derivative for derivative in derivatives]
        return measurement.residual(H, theta), jacobians + list(by_theta.T[:, :, None])

    dims = [6] * len(poses) + [1] * len(k_parameters)
    return CheckedFactor(evaluate, len(measurement.stack), [*poses, *k_parameters], dims)
