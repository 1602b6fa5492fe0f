"""The template measurement: every point-to-edge and point-to-plane residual of a scan, in 91 numbers.

Under H = T_target_lidar = (R, t) a point p on edge k of the template (in-plane outward unit normal n_k, offset c_k)
leaves the residual n_k . (R p + t) - c_k, and any return of the target leaves e_x . (R p + t) to the plane. Both
are linear in

    z = [vec R (column-major); t]  (12),

so all whitened rows of a scan stack into [A | r], whose triangular factor [L b; 0 c] keeps the cost exactly:
1/2 ||A z + r||^2 = 1/2 ||L z + b||^2 + 1/2 c^2, at any pose, however many points there were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Bools, Floats, Value, frozen
from optshape_graph.compiled import address, library
from optshape_graph.errors import InputError
from optshape_graph.factors._rows import checked, in_plane, marginalised, outer_rows, root, triangular
from optshape_graph.se3 import PoseLike, as_matrix, inverse, rotation, transform, vec, vec_derivative

FIRST_ROW = [0, 3, 6, 9]
"""Places of the first row of [R t] in z = [vec R; t]: all that a point on the plane x = 0 is linear in."""


def edge_rows(points: ArrayLike, normals: ArrayLike, offsets: ArrayLike) -> tuple[Floats, Floats]:
    """Return the rows A z + r of points on template edges, n_k . (R p + t) - c_k, metres, unweighted.

    Args:
        points: (N, 3) edge points, metres, LiDAR frame.
        normals: (N, 2) outward unit normal of each point's edge, (y, z) of the target frame.
        offsets: (N,) offset of each point's edge, metres.

    Returns:
        A (N, 12) and r (N,), linear in z = [vec R (column-major); t] of T_target_lidar.

    Raises:
        InputError: shapes that do not fit, or values that are not finite.
    """
    p = checked("points", points, (-1, 3))
    n = checked("normals", normals, (len(p), 2))
    return _rows(p, in_plane(n)), -checked("offsets", offsets, (len(p),))


def template_rows(points: ArrayLike, directions: ArrayLike, offsets: ArrayLike) -> tuple[Floats, Floats]:
    """Return the rows A z + r of m . (R p + t) - c for any direction m of the target frame, metres, unweighted.

    Args:
        points: (N, 3) metres, LiDAR frame.
        directions: (N, 3) m, target frame: (0, n_k) for an edge, (1, 0, 0) for the plane, (-mu, n_k) for the edge
            seen along a ray whose slope across the edge is mu.
        offsets: (N,) c, metres.

    Returns:
        A (N, 12) and r (N,), linear in z = [vec R (column-major); t] of T_target_lidar.

    Raises:
        InputError: shapes that do not fit, or values that are not finite.
    """
    p = checked("points", points, (-1, 3))
    m = checked("directions", directions, (len(p), 3))
    return _rows(p, m), -checked("offsets", offsets, (len(p),))


def _rows(points: Floats, directions: Floats) -> Floats:
    """Return the rows (N, 12) of m . (R p + t)."""
    rows = np.empty((len(points), 12))
    rows[:, :9], rows[:, 9:] = outer_rows(points, directions), directions
    return rows


def plane_rows(points: ArrayLike) -> tuple[Floats, Floats]:
    """Return the rows A z + r of points on the template's plane, e_x . (R p + t), metres, unweighted.

    Args:
        points: (N, 3) returns of the target, metres, LiDAR frame.

    Returns:
        A (N, 12) and r (N,), linear in z = [vec R (column-major); t] of T_target_lidar.

    Raises:
        InputError: points that are not N x 3, or not finite.
    """
    p = checked("points", points, (-1, 3))
    A = np.zeros((len(p), 12))
    A[:, FIRST_ROW] = np.column_stack([p, np.ones(len(p))])
    return A, np.zeros(len(p))


@dataclass(frozen=True, eq=False, repr=False)
class TemplateMeasurement(Value):
    """The cost 1/2 ||L z + b||^2 + 1/2 c^2 of one target in one scan, z = [vec R (column-major); t] of T_target_lidar.

    Plain data: it pickles, it does not grow with the number of points, and measurements of one placement whose
    errors are independent add up (`+`). Scans of a static scene share the bias of their rings: see `fuse_static`.

    Attributes:
        L: (12, 12) upper triangular, whitened.
        b: (12,) whitened.
        c: what remains at the best z, even where that is not a rigid transform.
        n_rows: number of scalar residuals it was made of: its degrees of freedom are these, not 12.
        T_target_lidar: (4, 4) pose it was taken at: where it is summarised unless another is given.

    Raises:
        InputError: shapes that do not fit, or values that are not finite.
    """

    L: Floats
    b: Floats
    c: float
    n_rows: int
    T_target_lidar: Floats

    def __post_init__(self) -> None:
        for field, shape in (("L", (12, 12)), ("b", (12,)), ("T_target_lidar", (4, 4))):
            object.__setattr__(self, field, frozen(checked(field, as_matrix(getattr(self, field)), shape)))
        if not np.isfinite(self.c):
            raise InputError(f"measurement c is {self.c}; expected a finite number")

    @classmethod
    def from_rows(cls, A: ArrayLike, r: ArrayLike, T_target_lidar: PoseLike) -> TemplateMeasurement:
        """Compress whitened rows A z + r.

        Args:
            A: (m, 12) whitened rows, any m.
            r: (m,) whitened constants.
            T_target_lidar: (4, 4) pose the measurement is taken at.

        Raises:
            InputError: shapes that do not fit, or values that are not finite.
        """
        rows = checked("rows", A, (-1, 12))
        constants = checked("constants", r, (len(rows),))
        return cls.from_stack(np.column_stack([rows, constants]), len(rows), T_target_lidar)

    @classmethod
    def from_edge_points(
        cls,
        points: ArrayLike,
        normals: ArrayLike,
        offsets: ArrayLike,
        sigma: float,
        plane_sigma: float,
        T_target_lidar: PoseLike,
    ) -> TemplateMeasurement:
        """Compress edge points of one accuracy, each on its edge and on the target's plane.

        Args:
            points: (N, 3) edge points, metres, LiDAR frame.
            normals: (N, 2) outward unit normal of each point's edge, (y, z) of the target frame.
            offsets: (N,) offset of each point's edge, metres.
            sigma: standard deviation across the edge, metres.
            plane_sigma: standard deviation across the plane, metres.
            T_target_lidar: (4, 4) pose the measurement is taken at.

        Raises:
            InputError: shapes that do not fit, or values that are not finite.
        """
        p = checked("points", points, (-1, 3))
        n = checked("normals", normals, (len(p), 2))
        across = np.zeros((2 * len(p), 3))  # directions of the target frame: of the edges, then of the plane
        across[: len(p), 1:], across[len(p) :, 0] = n / sigma, 1.0 / plane_sigma
        stack = np.zeros((len(across), 13))
        stack[:, :9] = outer_rows(np.concatenate([p, p]), across)
        stack[:, 9:12] = across
        stack[: len(p), 12] = checked("offsets", offsets, (len(p),)) / -sigma
        return cls.from_stack(stack, len(stack), T_target_lidar)

    @classmethod
    def from_stack(cls, stack: Floats, n_rows: int, T_target_lidar: PoseLike) -> TemplateMeasurement:
        """Compress rows (m, 13), linear in [z; 1], that stand for `n_rows` residuals."""
        R = triangular(stack)
        return cls(R[:12, :12], R[:12, 12], abs(float(R[12, 12])), n_rows, as_matrix(T_target_lidar))

    @property
    def stack(self) -> Floats:
        """(13, 13) rows [L b; 0 c]: the measurement as thirteen residuals, linear in [z; 1]."""
        stack = np.zeros((13, 13))
        stack[:12, :12], stack[:12, 12], stack[12, 12] = self.L, self.b, self.c
        return stack

    def __add__(self, other: TemplateMeasurement) -> TemplateMeasurement:
        """Return the measurement of both scans, errors independent, taken at the pose of the first."""
        if not isinstance(other, TemplateMeasurement):
            return NotImplemented
        return self.from_stack(np.vstack([self.stack, other.stack]), self.n_rows + other.n_rows, self.T_target_lidar)

    def at(self, T_target_lidar: PoseLike) -> TemplateMeasurement:
        """Return the same measurement, taken at another pose (4, 4)."""
        return replace(self, T_target_lidar=as_matrix(T_target_lidar))

    def substituted(self, T_target_a: PoseLike, T_b_lidar: PoseLike | None = None) -> TemplateMeasurement:
        """Return the measurement as one of T_a_b, where T_target_lidar = T_target_a T_a_b T_b_lidar.

        The entries of T_target_lidar are linear in those of T_a_b, so this is exact too.

        Args:
            T_target_a: (4, 4) known transform on the left.
            T_b_lidar: (4, 4) known transform on the right; None: the identity.
        """
        A = as_matrix(T_target_a)
        B = np.eye(4) if T_b_lidar is None else as_matrix(T_b_lidar)
        M = substitution(A, B)
        return self.from_stack(self.stack @ M, self.n_rows, inverse(A) @ self.T_target_lidar @ inverse(B))

    def loosened(self, covariance: ArrayLike) -> TemplateMeasurement:
        """Return the measurement as one of T_target_lidar T, T being the identity but for an error of its own.

        It is for a LiDAR whose motion since the returns is not exactly known.

        Args:
            covariance: (6, 6) of T's tangent vector, rotation first.
        """
        columns = np.zeros((13, 6))
        columns[:12] = self.jacobian(self.T_target_lidar) @ root(covariance)
        return self.from_stack(marginalised(columns, self.stack), self.n_rows, self.T_target_lidar)

    def residual(self, T_target_lidar: PoseLike) -> Floats:
        """Return L z + b (12,) at a pose (4, 4)."""
        return self.L @ vec(as_matrix(T_target_lidar)) + self.b

    def jacobian(self, T_target_lidar: PoseLike) -> Floats:
        """Return the derivative (12, 6) of the residual by a right perturbation of T_target_lidar, rotation first."""
        return self.L @ vec_derivative(as_matrix(T_target_lidar))

    def error(self, T_target_lidar: PoseLike) -> float:
        """Return 1/2 ||L z + b||^2 + 1/2 c^2 at a pose (4, 4): half the sum of the squared whitened rows."""
        residual = self.residual(T_target_lidar)
        return 0.5 * float(residual @ residual) + 0.5 * self.c**2

    def gradient(self, T_target_lidar: PoseLike) -> Floats:
        """Return the gradient (6,) of the error by a right perturbation of T_target_lidar, rotation first."""
        return self.jacobian(T_target_lidar).T @ self.residual(T_target_lidar)

    def information(self, T_target_lidar: PoseLike | None = None) -> Floats:
        """Return the Gauss-Newton information (6, 6) of a right perturbation of T_target_lidar, rotation first.

        Args:
            T_target_lidar: (4, 4) where; None: at the pose the measurement was taken at.
        """
        J = self.jacobian(self.T_target_lidar if T_target_lidar is None else T_target_lidar)
        return J.T @ J

    def quadratic(self) -> Floats:
        """Return the matrix Q (13, 13) with error = 1/2 [z; 1]^T Q [z; 1]."""
        return self.stack.T @ self.stack


def refine(measurement: TemplateMeasurement) -> Floats:
    """Return the T_target_lidar (4, 4) nearest to where a measurement was taken that minimises its error."""
    return np.asarray(refine_all([measurement], measurement.T_target_lidar[None])[0])


def refine_all(measurements: Sequence[TemplateMeasurement], starts: Floats, iterations: int = 20) -> Floats:
    """Return the T_target_lidar (B, 4, 4) nearest to starts (B, 4, 4) that minimise the errors of measurements.

    Gauss-Newton steps on the compressed rows, with Levenberg's damping where they do not lead down.
    """
    T, L, b = starts, np.stack([one.L for one in measurements]), np.stack([one.b for one in measurements])
    functions = library()
    if functions is not None and starts.shape == (len(L), 4, 4):
        found = np.empty((len(L), 4, 4))
        arrays = [np.ascontiguousarray(one, dtype=np.float64) for one in (L, b, starts)]
        functions.nearest_minima(len(L), *map(address, arrays), iterations, address(found))
        return found
    residual, damping = _residuals(L, b, T), np.full(len(starts), 1e-12)
    error = np.vecdot(residual, residual)
    for _ in range(iterations):
        J = L @ vec_derivative(T)
        Jt, trace = np.swapaxes(J, 1, 2), np.einsum("bij,bij->b", J, J)
        step = -np.linalg.solve(Jt @ J + (damping * trace)[:, None, None] * np.eye(6), Jt @ residual[..., None])[..., 0]
        candidate = T @ transform(rotation(step[:, :3]), step[:, 3:])
        left = _residuals(L, b, candidate)
        new = np.vecdot(left, left)
        down = new <= error
        T, residual, error = _where(down, candidate, T), _where(down, left, residual), np.where(down, new, error)
        damping = np.where(down, np.maximum(damping / 10, 1e-12), np.maximum(10 * damping, 1e-8))
        if ((np.abs(step).max(axis=1) < 1e-9) | (damping > 1.0)).all():
            break
    return T


def _where(mask: Bools, a: Floats, b: Floats) -> Floats:
    """Return items (B, ...) of a where a mask (B,) says so, else of b."""
    return np.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def _residuals(L: Floats, b: Floats, T: Floats) -> Floats:
    """Return L z + b (B, 12) at poses (B, 4, 4)."""
    return np.asarray((L @ vec(T)[..., None])[..., 0] + b)


class Measured(Protocol):
    """What was made of a measurement, and carries it: an estimate, a detection."""

    @property
    def measurement(self) -> TemplateMeasurement:
        """Of T_target_lidar."""


def measurement_of(measured: TemplateMeasurement | Measured) -> TemplateMeasurement:
    """Return the measurement that a factor is to be made of.

    Args:
        measured: the measurement, or an estimate that carries it.

    Raises:
        InputError: neither, or an estimate that failed or is doubtful.
    """
    if isinstance(measured, TemplateMeasurement):
        return measured
    found = getattr(measured, "measurement", None)
    if not isinstance(found, TemplateMeasurement):
        raise InputError(f"expected an estimate or a TemplateMeasurement, found a {type(measured).__name__}")
    status = getattr(measured, "status", "")
    if status in ("failed", "doubtful"):
        raise InputError(f"no factor can be made of a {status} estimate: {getattr(measured, 'reason', '')}")
    return found


def substitution(T_target_a: PoseLike, T_b_lidar: PoseLike | None = None) -> Floats:
    """Return the matrix (13, 13) that takes [z; 1] of T_a_b to that of T_target_lidar = T_target_a T_a_b T_b_lidar."""
    A = as_matrix(T_target_a)
    B = np.eye(4) if T_b_lidar is None else as_matrix(T_b_lidar)
    # Columns of the upper 3 x 4 of A T B: R_A [R t] B + t_A e_4^T.
    M = np.eye(13)
    M[:12, :12] = np.kron(B.T, A[:3, :3])
    M[9:12, 12] = A[:3, 3]
    return M
