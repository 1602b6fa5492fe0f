"""A pose that was sampled as a measurement: rows linear in the pose whose minimum and covariance are the samples'."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.factors.static import EDGE_OFFSET, BiasedMeasurement, SharedError
from optshape_graph.se3 import vec, vec_derivative

MOST = 0.5
"""Share of a sampled pose's variance, in any direction, that errors which scans share explain at most: by how far they
displace the pose differs a little from scan to scan, and where little is left that difference would tell the errors."""


@dataclass(frozen=True, eq=False, repr=False)
class SampledPose(Value):
    """What samples say of the best mode.

    Attributes:
        T_target_lidar: (4, 4) posterior mean.
        offset: mean of the offset across the edges, in beam widths.
        covariance: (7, 7) of the right perturbation of T_target_lidar, rotation first, and of the offset.
        errors: (K,) what other scans of the sensor or of the scene share: where rings look, and where the target ends.
        effect: (7, K) how far the truth lies from pose (rad, metres) and offset (beam widths) for a standard deviation
            of each.
    """

    T_target_lidar: Floats
    offset: float
    covariance: Floats
    errors: tuple[SharedError, ...]
    effect: Floats


def sampled_measurement(
    sampled: SampledPose, on_plane: BiasedMeasurement, offset_sd: float
) -> tuple[BiasedMeasurement, float]:
    """Say of a pose that was sampled what the plane and the edges say together.

    To samples, what scans of one sensor or scene share is a blur. Each such error becomes a column of its own, which
    displaces pose and offset, and its part is taken out of the blur.

    Args:
        sampled: pose and offset.
        on_plane: what the returns of the plane say.
        offset_sd: standard deviation of the offset before the scan, in beam widths.

    Returns:
        The measurement of plane and edges, and the sum of 1 / sigma^2 of the edges, 1/m2.
    """
    T, root = sampled.T_target_lidar, np.linalg.cholesky(sampled.covariance)
    directions, size, errors = np.linalg.svd(np.linalg.solve(root, sampled.effect), full_matrices=False)
    effect = root @ (directions * np.minimum(size, np.sqrt(MOST))) @ errors
    blur = replace(sampled, covariance=sampled.covariance - effect @ effect.T)
    on_edges, weight = _blurred_measurement(blur, on_plane, offset_sd)
    shared = on_edges + on_plane
    k = len(shared.shared)
    columns = {error: shared.stack[:, i] for i, error in enumerate(shared.shared)}
    A = shared.stack[:, k:-1]
    J = np.column_stack([A @ vec_derivative(T), columns[SharedError(EDGE_OFFSET)] / offset_sd])
    for error, moved in zip(sampled.errors, -(J @ effect).T, strict=True):
        columns[error] = columns.get(error, 0.0) + moved
    B = np.column_stack(list(columns.values()))
    measurement = BiasedMeasurement.from_rows(A, B, shared.stack[:, -1], T, list(columns))
    return replace(measurement, n_rows=shared.n_rows), weight


def _blurred_measurement(
    sampled: SampledPose, on_plane: BiasedMeasurement, offset_sd: float
) -> tuple[BiasedMeasurement, float]:
    """Say of the edges what, with the plane, makes the pose that was sampled, its covariance and the offset's.

    Near the mean (R0, t0) a right perturbation (w, v) is linear in z = [vec R; t]: w is half of what is skew in
    R0^T R, and v = R0^T (t - t0). w vanishes for a half turn too; two rows of second order, the diagonal of R0^T R less
    1, tell that apart.

    Args:
        sampled: pose and offset.
        on_plane: what the returns of the plane say.
        offset_sd: standard deviation of the offset before the scan, in beam widths.

    Returns:
        The measurement, in z and the common offset, and the sum of 1 / sigma^2, 1/m2.
    """
    T = sampled.T_target_lidar
    scale = np.append(np.ones(6), offset_sd)
    total = np.linalg.inv(sampled.covariance) * np.outer(scale, scale)
    elsewhere, pull = np.zeros((7, 7)), np.zeros(7)  # of the plane, and of the offset's prior
    plane = on_plane.of_one_scan().at(T)
    J = plane.jacobian(T)
    elsewhere[:6, :6], elsewhere[6, 6] = J.T @ J, 1.0
    pull[:6], pull[6] = J.T @ plane.residual(T), sampled.offset / offset_sd
    # What is left is the edges'. Where samples scatter more than the plane alone would let them, almost nothing is.
    root = np.linalg.cholesky(total)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, total - elsewhere).T))
    values = np.maximum(values, 1e-3)
    whiten = np.sqrt(values)[:, None] * (root @ vectors).T
    constant = whiten @ np.append(np.zeros(6), -sampled.offset / offset_sd) - np.linalg.solve(whiten.T, pull)
    K = 0.5 * vec_derivative(T).T
    K[3:] *= 2.0
    straight = np.array([_diagonal(T, axis) for axis in (1, 2)]) * np.sqrt(0.5 * total[0, 0])
    A = np.vstack([whiten[:, :6] @ K, straight])
    r = np.concatenate([constant - whiten[:, :6] @ K @ vec(T), -np.full(2, np.sqrt(0.5 * total[0, 0]))])
    B = np.concatenate([whiten[:, 6], np.zeros(2)])[:, None]
    measurement = BiasedMeasurement.from_rows(A, B, r, T, [SharedError(EDGE_OFFSET)])
    return measurement, float(np.trace(total[4:6, 4:6]))


def _diagonal(T: Floats, axis: int) -> Floats:
    """(12,) row of an entry on the diagonal of R0^T R in z, for T = (R0, t0) (4, 4)."""
    entry = np.zeros((4, 3))
    entry[axis] = T[:3, axis]  # column by column
    return entry.ravel()
