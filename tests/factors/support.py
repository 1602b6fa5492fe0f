"""Random poses and edge points, and numerical derivatives, for the tests of factors and graph."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
from hypothesis import strategies as st

from optshape_graph import Target
from optshape_graph.factors import TemplateMeasurement, edge_rows, plane_rows

TARGET = Target.from_polygon([(-0.6, -0.35), (0.45, -0.5), (0.7, 0.3), (-0.3, 0.65)])

seeds = st.integers(0, 2**32 - 1)
"""Seeds of the generators that the properties draw from."""

scales = st.sampled_from([1e-7, 1e-3, 1.0, 3.0])
"""Tangent norms of random poses: near the identity and far from it."""


def random_pose(rng: np.random.Generator, scale: float = 1.0, distance: float = 5.0) -> np.ndarray:
    """Return a (4, 4) pose whose rotation angle is about `scale` rad, at most pi, and translation `distance` m."""
    axis = rng.normal(size=3)
    rotation = axis / np.linalg.norm(axis) * min(scale, np.pi - 1e-3)
    T = gtsam.Rot3.Expmap(rotation).matrix()
    return np.block([[T, rng.normal(size=(3, 1)) * distance * min(scale, 1.0)], [np.zeros((1, 3)), np.ones((1, 1))]])


def retract(T: np.ndarray, xi: np.ndarray) -> np.ndarray:
    return np.asarray(T @ gtsam.Pose3.Expmap(xi).matrix())


def log(T: np.ndarray) -> np.ndarray:
    return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(T)))


def numerical(function: Callable[[np.ndarray], np.ndarray], n: int, step: float = 1e-5) -> np.ndarray:
    """Return the central-difference Jacobian (m, n) of a function of a tangent vector (n,), at zero."""
    return np.stack([(function(step * e) - function(-step * e)) / (2 * step) for e in np.eye(n)], axis=-1)


def edge_points(
    rng: np.random.Generator, T_lidar_target: np.ndarray, n: int, target: Target = TARGET, noise: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, 3) points on the target's edges, LiDAR frame, with noise in all axes, and their edges (n,)."""
    edge = np.arange(n) % len(target)
    along = rng.uniform(0.05, 0.95, (n, 1))
    on_edge = (1 - along) * target.vertices[edge] + along * np.roll(target.vertices, -1, axis=0)[edge]
    points = (on_edge + noise * rng.normal(size=(n, 3))) @ T_lidar_target[:3, :3].T + T_lidar_target[:3, 3]
    return points, edge


def measure(
    rng: np.random.Generator,
    T_target_lidar: np.ndarray,
    n: int = 40,
    sigma: float = 0.01,
    target: Target = TARGET,
    noise: float | None = None,
) -> TemplateMeasurement:
    """Return the measurement of noisy edge points, whose errors across edge and plane have deviation sigma."""
    T_lidar_target = np.linalg.inv(T_target_lidar)
    points, edge = edge_points(rng, T_lidar_target, n, target, sigma if noise is None else noise)
    A, r = edge_rows(points, target.normals[edge], target.offsets[edge])
    P, s = plane_rows(points)
    return TemplateMeasurement.from_rows(np.vstack([A, P]) / sigma, np.append(r, s) / sigma, T_target_lidar)


def minimise(measurement: TemplateMeasurement, T: np.ndarray, iterations: int = 20) -> np.ndarray:
    """Return the pose of least error by Gauss-Newton."""
    for _ in range(iterations):
        T = retract(T, -np.linalg.solve(measurement.information(T), measurement.gradient(T)))
    return T
