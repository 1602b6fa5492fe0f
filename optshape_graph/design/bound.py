"""The Cramer-Rao bound on a target's pose, for a sensor and a placement.

No unbiased estimate that knows which ring end is on which edge has a smaller covariance. The noise is that of the
sensor:

- A ring's end is quantised along the ring by an azimuth step: variance (s step)^2 / 12, with s the in-plane metres per
  radian. It is taken for Gaussian of that variance, since the uniform distribution itself has no bound.
- The beam's width w moves a ring's end across the edge, by an offset of its own and by one that all ends share, each
  uniform over w, of variance w^2 / 12.
- Ranges have noise, and each ring has a range bias. Errors that rings or ends share do not average away.
- Noise of azimuths moves every point along its ring. Noise of elevations costs nothing: the sensor's table has the true
  ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Floats, Value
from optshape_graph.errors import InputError
from optshape_graph.se3 import rotation, transform
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

TURN = 2 * np.pi


@dataclass(frozen=True)
class PoseBound:
    """Bounds on the root mean square errors over placements: the median and the worst placement.

    Attributes:
        distance: of the target, metres.
        e_t: (median, worst) of the translation, metres; infinite where the pose is not determined.
        e_r: (median, worst) of the rotation, rad.
        e_in_plane: (median, worst) of the rotation about the target's normal, rad.
    """

    distance: float
    e_t: tuple[float, float]
    e_r: tuple[float, float]
    e_in_plane: tuple[float, float]


def pose_bound(target: Target, sensor: SensorModel, distance: float, turns: int = 36, placements: int = 3) -> PoseBound:
    """Bound the pose error of a target that faces the sensor, over orientations and heights.

    Args:
        target: the target, of its own area.
        sensor: the sensor, whose azimuth step must be known.
        distance: of the target's plane, metres.
        turns: orientations about the normal, evenly over a full turn.
        placements: heights of the centre within a gap between the two rings nearest to the horizon.

    Raises:
        InputError: the azimuth step is not known, or `distance` is not positive.
    """
    if not (np.isfinite(distance) and distance > 0):
        raise InputError(f"expected a positive distance; found {distance} m")
    above = int(np.searchsorted(sensor.elevations, 0.0).clip(1, max(sensor.n_rings - 1, 1)))
    around = np.tan(sensor.elevations[max(above - 1, 0) : above + 1])
    heights = distance * (around[0] + np.ptp(around) * np.arange(placements) / placements)
    angles, heights = (grid.ravel() for grid in np.meshgrid(TURN * np.arange(turns) / turns, heights))
    poses = transform(
        rotation(np.outer(angles, [1.0, 0.0, 0.0])),
        np.column_stack([np.full((len(heights), 2), [distance, 0.0]), heights]),
    )
    variances = np.diagonal(covariance_bound(target, sensor, poses), axis1=1, axis2=2)

    def summary(columns: slice) -> tuple[float, float]:
        rms = np.sqrt(variances[:, columns].sum(axis=1))
        return float(np.median(rms)), float(rms.max())

    return PoseBound(distance, summary(slice(3, 6)), summary(slice(0, 3)), summary(slice(0, 1)))


def covariance_bound(target: Target, sensor: SensorModel, T_lidar_target: Floats, azimuth_noise: float = 0.0) -> Floats:
    """Return the (..., 6, 6) Cramer-Rao bounds of poses, rotation first, right perturbation; infinite if undetermined.

    Args:
        target: the target.
        sensor: the sensor, whose azimuth step must be known.
        T_lidar_target: (..., 4, 4).
        azimuth_noise: standard deviation of the azimuth of a point, rad.

    Raises:
        InputError: the azimuth step is not known, or the target is not in front of the sensor's own side.
    """
    return bound_of(pose_information(target, sensor, T_lidar_target, azimuth_noise), target.circumradius)


def bound_of(information: Floats, size: float) -> Floats:
    """Return the (..., 6, 6) inverses of pose informations, infinite where singular; `size`: of the target, metres."""
    # Columns in comparable units: rotations by the target's size.
    scale = np.repeat([size, 1.0], 3)
    scaled = information / np.outer(scale, scale)
    eigenvalues = np.linalg.eigvalsh(scaled)
    determined = eigenvalues[..., 0] > 1e-12 * eigenvalues[..., -1]
    solvable = np.where(determined[..., None, None], scaled, np.eye(6))
    bounds = np.linalg.inv(solvable) / np.outer(scale, scale)
    return np.asarray(np.where(determined[..., None, None], bounds, np.inf))


def pose_information(target: Target, sensor: SensorModel, T_lidar_target: Floats, azimuth_noise: float = 0.0) -> Floats:
    """Return the (..., 6, 6) Fisher information of poses, rotation first, right perturbation; see `covariance_bound`.

    Raises:
        InputError: the azimuth step is not known, or the sensor is not on the target's -x side.
    """
    T = np.asarray(T_lidar_target, dtype=float)
    rows = measured_rows(target, sensor, T.reshape(-1, 4, 4), azimuth_noise)
    # Each ring's bias, eliminated from the rows of its ring (Schur complement); then the offset that all ends share.
    J = np.concatenate([rows.J, rows.shared[..., None]], axis=-1)
    weighted = rows.weight[..., None] * J
    own = np.einsum("brki,brkj->brij", weighted, J)
    with_bias = np.einsum("brki,brk->bri", weighted, rows.bias)
    of_bias = 1.0 + (rows.weight * rows.bias**2).sum(axis=-1)
    seven = (own - with_bias[..., None] * with_bias[..., None, :] / of_bias[..., None, None]).sum(axis=1)
    across = seven[:, :6, 6]
    six = seven[:, :6, :6] - across[:, :, None] * across[:, None] / (1.0 + seven[:, 6, 6])[:, None, None]
    return np.asarray(six.reshape(*T.shape[:-2], 6, 6))


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredRows(Value):
    """K measured rows of each of R rings for B poses; the rows of a ring that misses the target have weight 0.

    Attributes:
        J: (B, R, K, 6) derivatives of the measured numbers by the pose's right perturbation.
        weight: (B, R, K) number of returns that a row stands for, over the variance of its own error.
        bias: (B, R, K) change by one standard deviation of the ring's range bias.
        shared: (B, R, K) change by one standard deviation of the offset that all ring ends share.
    """

    J: Floats
    weight: Floats
    bias: Floats
    shared: Floats


def measured_rows(target: Target, sensor: SensorModel, T: Floats, azimuth_noise: float = 0.0) -> MeasuredRows:
    """Return the rows of (B, 4, 4) poses: n for the ring's crossings with n edges, n + 1 for the returns between.

    The returns of a ring lie on a nearly straight chord, so Simpson's rule at its ends and middle gives their moments.

    Raises:
        InputError: the azimuth step is not known, or the sensor is not on the target's -x side.
    """
    if sensor.azimuth_step is None:
        raise InputError(f"sensor '{sensor.name}': its azimuth step has to be known for a bound")
    R, t = T[:, :3, :3], T[:, :3, 3]
    if (np.einsum("bi,bi->b", R[:, :, 0], t) <= 0).any():
        raise InputError(f"target '{target.name}': the sensor is not on its -x side, in front of its plane")
    hit, q = _crossings(target, sensor, T)
    middle = (q * hit[..., None]).sum(axis=2, keepdims=True) / np.maximum(hit.sum(axis=2), 1)[..., None, None]
    n = len(target)
    points = np.concatenate([q, q, middle], axis=2)  # (B, rings, 2 n + 1, 3), target frame
    normals = np.zeros((2 * n + 1, 3))
    normals[:n, 1:] = target.normals
    normals[n:, 0] = 1.0
    p = np.einsum("bij,brkj->brki", R, points) + t[:, None, None]
    N = np.einsum("bij,kj->bki", R, normals)[:, None]
    ranges = np.linalg.norm(p, axis=-1)
    by_azimuth = np.stack([-p[..., 1], p[..., 0], np.zeros_like(ranges)], axis=-1)
    plane = R[:, None, None, :, 0]
    along_ring = by_azimuth - p * ((by_azimuth * plane).sum(-1) / (p * plane).sum(-1))[..., None]
    per_range = (p * N).sum(-1) / ranges

    azimuth = np.angle((p[:, :, :n, 0] + 1j * p[:, :, :n, 1]) * (t[:, 0] - 1j * t[:, 1])[:, None, None])
    span = np.where(hit, azimuth, -np.inf).max(axis=2) - np.where(hit, azimuth, np.inf).min(axis=2)
    returns = np.where(hit.any(axis=2), span, 0.0) / sensor.azimuth_step
    # A ring whose chord is shorter than a step returns only at times.
    ends = hit * np.minimum(returns, 1.0)[..., None]
    count = np.concatenate([ends, hit * returns[..., None] / 6.0, returns[..., None] * 4.0 / 6.0], axis=2)

    width = np.zeros_like(ranges)
    width[..., :n] = sensor.beam_aperture + sensor.beam_divergence * ranges[..., :n]
    variance = (per_range * sensor.range_noise) ** 2 + ((by_azimuth * N).sum(-1) * azimuth_noise) ** 2
    variance[..., :n] += ((along_ring * N).sum(-1)[..., :n] * sensor.azimuth_step) ** 2 / 12.0
    variance += width**2 / 12.0
    # Moving the target by (omega, v) moves a point on it, held in space, by -(omega x q + v) relative to it. A
    # noiseless row would be infinitely informative; a micrometre is as good as none.
    J = np.concatenate([np.cross(points, normals), np.broadcast_to(normals, points.shape)], axis=-1)
    return MeasuredRows(J, count / (variance + 1e-12), per_range * sensor.ring_bias, width / np.sqrt(12.0))


def _crossings(target: Target, sensor: SensorModel, T: Floats) -> tuple[Bools, Floats]:
    """Return (B, R, n) which rings cross which edges, and (B, R, n, 3) where in the target frame; 0 if they don't.

    Only rings that cross an edge of some pose are listed.
    """
    a = target.vertices
    b = np.roll(a, -1, axis=0)
    starts = np.einsum("bij,nj->bni", T[:, :3, :3], a) + T[:, None, :3, 3]
    along = np.roll(starts, -1, axis=1) - starts
    slopes = np.tan(sensor.elevations)
    low, high = _slope(starts).min() - 0.05, _slope(starts).max() + 0.05
    slopes = slopes[(slopes >= low) & (slopes <= high)][:, None]

    def above(p: Floats) -> Floats:
        return np.asarray(p[..., 2] - slopes * np.hypot(p[..., 0], p[..., 1]))

    P, D = starts[:, None], along[:, None]
    first = above(P)
    last = np.roll(first, -1, axis=2)
    hit = (first < 0) != (last < 0)
    share = np.where(hit, first / np.where(hit, first - last, 1.0), 0.0)
    for _ in range(3):  # Newton: a ring is almost straight over an edge
        at = P + share[..., None] * D
        slope = D[..., 2] - slopes * (at[..., 0] * D[..., 0] + at[..., 1] * D[..., 1]) / np.hypot(
            at[..., 0], at[..., 1]
        )
        share = np.where(hit, np.clip(share - above(at) / np.where(hit, slope, 1.0), 0.0, 1.0), 0.0)
    return hit, np.where(hit[..., None], a + share[..., None] * (b - a), 0.0)


def _slope(p: Floats) -> Floats:
    """Return the tangent of the elevation of points (..., 3)."""
    return np.asarray(p[..., 2] / np.hypot(p[..., 0], p[..., 1]))
