"""Vertices as variables: rigid to the target's pose, or free with the template as prior.

A line of the template spans, with its plane's normal, no more than a plane pi_k = (n_k, -c_k) through the edge, and a
point's residual to it is [p; 1] . (H^T pi_k): planes map by the transposed pose. So the points of edge k enter through
H^T pi_k (4 numbers) alone, those of the target's own plane through H^T (e_x, 0), and whitened rows of any number of
points stack into a triangular matrix over 4 (n + 1) columns, which is exact for every pose *and every shape*.

Vertices are Point3 variables of the target frame. Only their (y, z) shape the edges; x is held by the prior at 0, the
template's plane.
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
from optshape_graph.factors._rows import checked, checked_keys, marginalised, root, triangular
from optshape_graph.factors.measurement import TemplateMeasurement
from optshape_graph.se3 import PoseLike, as_matrix, as_transform, skew

RIGID_SIGMA_M = 1e-4
"""How rigidly a vertex is tied to its target, metres: far below what any LiDAR resolves, far above rounding."""


def shape_rows(points: ArrayLike, edges: ArrayLike, n_edges: int) -> Floats:
    """Return the rows (N, 4 n + 4) of points on edges, or on the plane, metres, unweighted.

    Args:
        points: (N, 3) metres, LiDAR frame.
        edges: (N,) edge of each point; n_edges where the point is one of the target's plane.
        n_edges: n, number of the template's edges.

    Raises:
        InputError: shapes that do not fit, values that are not finite, or an edge that the template does not have.
    """
    p = checked("points", points, (-1, 3))
    k = checked("edges", edges, (len(p),)).astype(int)
    if len(k) and (k.min() < 0 or k.max() > n_edges):
        raise InputError(f"edges run from {k.min()} to {k.max()}; expected 0 to {n_edges}")
    rows = np.zeros((len(p), n_edges + 1, 4))
    rows[np.arange(len(p)), k] = np.column_stack([p, np.ones(len(p))])
    return rows.reshape(len(p), -1)


@dataclass(frozen=True, eq=False, repr=False)
class ShapeMeasurement(Value):
    """The cost 1/2 ||U g||^2 of one target of unknown shape in one scan, g the planes H^T pi_k stacked.

    Attributes:
        U: (4 n + 4, 4 n + 4) upper triangular, whitened.
        n_rows: number of scalar residuals it was made of.
        T_target_lidar: (4, 4) pose it was taken at.

    Raises:
        InputError: shapes that do not fit, or values that are not finite.
    """

    U: Floats
    n_rows: int
    T_target_lidar: Floats

    def __post_init__(self) -> None:
        size = len(self.U)
        if size % 4 or size < 16:
            raise InputError(f"shape measurement of {size} columns; expected 4 (n + 1) with n >= 3 edges")
        object.__setattr__(self, "U", frozen(checked("U", self.U, (size, size))))
        object.__setattr__(self, "T_target_lidar", as_transform(self.T_target_lidar, "T_target_lidar"))

    @classmethod
    def from_rows(cls, rows: ArrayLike, T_target_lidar: PoseLike) -> ShapeMeasurement:
        """Compress whitened rows (m, 4 n + 4), taken at a pose (4, 4).

        They are those of `shape_rows`, times any whitening matrix on the left.
        """
        stack = np.asarray(rows, float)
        checked("shape rows", stack, (-1, stack.shape[-1]))
        return cls(triangular(stack), len(stack), as_matrix(T_target_lidar))

    def loosened(self, covariance: ArrayLike, vertices: ArrayLike) -> ShapeMeasurement:
        """Return the measurement with an error of its own behind T_target_lidar; see `TemplateMeasurement`.

        Args:
            covariance: (6, 6) of the error's tangent vector, rotation first.
            vertices: (n, 3) about which the target's are, metres, target frame.
        """
        by_pose, _ = self.jacobians(self.T_target_lidar, vertices)
        return ShapeMeasurement(marginalised(by_pose @ root(covariance), self.U), self.n_rows, self.T_target_lidar)

    @property
    def n_edges(self) -> int:
        """Number of edges n, and of vertices."""
        return len(self.U) // 4 - 1

    def residual(self, T_target_lidar: PoseLike, vertices: ArrayLike) -> Floats:
        """Return U g (4 n + 4,) at a pose (4, 4) and vertices (n, 3), metres, target frame."""
        planes, _ = _planes(checked("vertices", vertices, (self.n_edges, 3)))
        return np.asarray(self.U @ (planes @ as_matrix(T_target_lidar)).ravel())

    def jacobians(self, T_target_lidar: PoseLike, vertices: ArrayLike) -> tuple[Floats, Floats]:
        """Return the derivatives of U g at a pose (4, 4) and vertices (n, 3), metres, target frame.

        Returns:
            By a right perturbation of the pose (., 6), rotation first; and by each vertex (n, ., 3), 1/m.
        """
        H, n = as_matrix(T_target_lidar), self.n_edges
        planes, derivative = _planes(checked("vertices", vertices, (n, 3)))
        g = planes @ H
        by_pose = np.zeros((n + 1, 4, 6))
        by_pose[:, :3, :3] = skew(g[:, :3])  # of R^T n, turned by the pose
        by_pose[:, 3, 3:] = g[:, :3]
        by_vertex = np.einsum("kvcj,ci->vkij", derivative, H).reshape(n, 4 * (n + 1), 3)
        return self.U @ by_pose.reshape(-1, 6), self.U @ by_vertex

    def error(self, T_target_lidar: PoseLike, vertices: ArrayLike) -> float:
        """Return half the sum of the squared whitened rows at a pose (4, 4) and vertices (n, 3), target frame."""
        return 0.5 * float(np.square(self.residual(T_target_lidar, vertices)).sum())

    def of_template(self, vertices: ArrayLike) -> TemplateMeasurement:
        """Return what is left when the vertices (n, 3), metres, target frame, are known: linear in z again."""
        planes, _ = _planes(checked("vertices", vertices, (self.n_edges, 3)))
        M = np.zeros((len(planes), 4, 13))
        for j in range(3):
            M[:, j, 3 * j : 3 * j + 3] = planes[:, :3]
        M[:, 3, 9:] = planes
        return TemplateMeasurement.from_stack(self.U @ M.reshape(-1, 13), self.n_rows, self.T_target_lidar)


def ShapeFactor(
    measurement: ShapeMeasurement, k_pose: int | tuple[int, int], k_vertices: Sequence[int]
) -> gtsam.CustomFactor:
    """Return the exact factor on a pose and the target's vertices, edges running between adjacent ones.

    It leaves the shape's own pose free: give every vertex a `TemplatePrior`.

    Args:
        measurement: of n edges.
        k_pose: key of T_target_lidar, or keys of T_world_target and T_world_lidar.
        k_vertices: keys of the n vertices, Point3 of the target frame, counter-clockwise seen from +x.

    Raises:
        InputError: another number of keys than of edges, or keys that are none or the same.
    """
    poses = k_pose if isinstance(k_pose, tuple) else (k_pose,)
    if len(k_vertices) != measurement.n_edges:
        raise InputError(f"{len(k_vertices)} vertex keys for a target of {measurement.n_edges} edges")

    def evaluate(values: gtsam.Values) -> tuple[Floats, list[Floats]]:
        H, derivatives = relative_pose(values, poses)
        vertices = np.stack([values.atPoint3(key) for key in k_vertices])
        by_pose, by_vertex = measurement.jacobians(H, vertices)
        return measurement.residual(H, vertices), [*(by_pose @ d for d in derivatives), *by_vertex]

    dims = [6] * len(poses) + [3] * len(k_vertices)
    return CheckedFactor(evaluate, len(measurement.U), [*poses, *k_vertices], dims)


def TemplatePrior(vertex: ArrayLike, k_vertex: int, sigma: float) -> gtsam.PriorFactorPoint3:
    """Return the prior of a free vertex of the target frame: the template's, in its plane.

    Args:
        vertex: (3,) template vertex, metres, target frame.
        k_vertex: key of the Point3 variable.
        sigma: standard deviation in the plane, metres: how well the target was built. Across it, RIGID_SIGMA_M.

    Raises:
        InputError: another vertex than three numbers, or a key that is none.
    """
    checked_keys(k_vertex)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([RIGID_SIGMA_M, sigma, sigma]))
    return gtsam.PriorFactorPoint3(k_vertex, checked("vertex", vertex, (3,)), noise)


def VertexFactor(vertex: ArrayLike, k_target: int, k_vertex: int) -> gtsam.BearingRangeFactor3D:
    """Return the compiled factor that ties a vertex in the world, a Point3, rigidly to T_world_target.

    Bearing and range fix a point in the target's frame, where no vertex is at the origin.

    Args:
        vertex: (3,) template vertex, metres, target frame.
        k_target: key of T_world_target.
        k_vertex: key of the vertex in the world frame.

    Raises:
        InputError: a vertex at the target's origin, or keys that are none or the same.
    """
    checked_keys(k_target, k_vertex)
    v = checked("vertex", vertex, (3,))
    reach = float(np.linalg.norm(v))
    if not reach > RIGID_SIGMA_M:
        raise InputError(f"vertex {v} lies at the target's origin, where its bearing is undefined")
    noise = gtsam.noiseModel.Diagonal.Sigmas(RIGID_SIGMA_M * np.array([1.0 / reach, 1.0 / reach, 1.0]))
    return gtsam.BearingRangeFactor3D(k_target, k_vertex, gtsam.Unit3(v), reach, noise)


def FreeVertexFactor(k_target: int, k_vertex: int, k_world: int) -> gtsam.ReferenceFrameFactorPoint3Pose3:
    """Return the compiled factor that ties a free vertex to its place in the world: v_world = T_world_target v.

    Args:
        k_target: key of T_world_target.
        k_vertex: key of the vertex in the target frame, a Point3.
        k_world: key of the vertex in the world frame, a Point3.

    Raises:
        InputError: keys that are none or the same.
    """
    checked_keys(k_target, k_vertex, k_world)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, RIGID_SIGMA_M)
    # GTSAM's frames are the other way round: its transform maps what it calls global into what it calls local.
    return gtsam.ReferenceFrameFactorPoint3Pose3(k_vertex, k_target, k_world, noise)


def _planes(vertices: Floats) -> tuple[Floats, Floats]:
    """Return the planes pi_k (n + 1, 4), the target's own last, and their derivatives (n + 1, n, 4, 3) by vertex."""
    n = len(vertices)
    following = (np.arange(n) + 1) % n
    edge = vertices[following] - vertices
    edge[:, 0] = 0.0
    length = np.linalg.norm(edge, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = edge / length
        turning = 1.0 / length
    normal = np.column_stack([np.zeros(n), along[:, 2], -along[:, 1]])
    planes = np.zeros((n + 1, 4))
    planes[:n, :3], planes[:n, 3] = normal, -np.einsum("ki,ki->k", normal, vertices)
    planes[n, 0] = 1.0
    # With edge e = v' - v: dn = -along (n . de) / |e|, and c = n . v.
    turn = -np.einsum("ki,kj->kij", along, normal) * turning[:, :, None]
    lift = np.einsum("ki,kij->kj", vertices, turn)
    derivative = np.zeros((n + 1, n, 4, 3))
    k = np.arange(n)
    derivative[k, k, :3], derivative[k, following, :3] = -turn, turn
    derivative[k, k, 3], derivative[k, following, 3] = lift - normal, -lift
    return planes, derivative
