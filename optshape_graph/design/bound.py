"""The Cramer-Rao bound on a target's pose, for a sensor and a placement.

No unbiased estimate that knows which ring end is on which edge has a smaller covariance. The noise is what the sensor
does: a ring's end is known along the ring to a uniform quantiser of one azimuth step, variance (s step)^2 / 12 with s
the in-plane metres per radian (taken as Gaussian of that variance: the uniform distribution itself has no bound);
which part of the beam decides moves it across the edge, by something of its own and by something that all ends share,
each uniform over the beam's width w and of variance w^2 / 12; ranges have noise; and each ring a bias of its own. What
rings or ends share does not average away. Azimuths that are themselves measured with noise move every point along its
ring. Elevations with noise cost nothing: the sensor's table has the true ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.errors import InputError
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

TURN = 2 * np.pi


@dataclass(frozen=True)
class PoseBound:
    """Bounds over placements: root mean squares of the errors, one number per placement reduced to two.

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
        target: the target, its area as it is.
        sensor: the sensor; its azimuth step has to be known.
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
    covariances = []
    for height in heights:
        for angle in TURN * np.arange(turns) / turns:
            c, s = np.cos(angle), np.sin(angle)
            T = np.array([[1, 0, 0, distance], [0, c, -s, 0], [0, s, c, height], [0, 0, 0, 1.0]])
            covariances.append(covariance_bound(target, sensor, T))
    variances = np.array([np.diag(covariance) for covariance in covariances])

    def summary(columns: slice) -> tuple[float, float]:
        rms = np.sqrt(variances[:, columns].sum(axis=1))
        return float(np.median(rms)), float(rms.max())

    return PoseBound(distance, summary(slice(3, 6)), summary(slice(0, 3)), summary(slice(0, 1)))


def covariance_bound(target: Target, sensor: SensorModel, T_lidar_target: Floats, azimuth_noise: float = 0.0) -> Floats:
    """(6, 6) Cramer-Rao bound of T_lidar_target, rotation first, right perturbation; infinite if not determined.

    Args:
        target: the target.
        sensor: the sensor; its azimuth step has to be known.
        T_lidar_target: (4, 4).
        azimuth_noise: standard deviation of the azimuth of a point, rad.

    Raises:
        InputError: the azimuth step is not known, or the target is not in front of the sensor's own side.
    """
    information = pose_information(target, sensor, T_lidar_target, azimuth_noise)
    # Columns in comparable units: rotations by the target's size.
    scale = np.repeat([target.circumradius, 1.0], 3)
    scaled = information / np.outer(scale, scale)
    eigenvalues = np.linalg.eigvalsh(scaled)
    if eigenvalues[0] <= 1e-12 * eigenvalues[-1]:
        return np.full((6, 6), np.inf)
    return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))


def pose_information(target: Target, sensor: SensorModel, T_lidar_target: Floats, azimuth_noise: float = 0.0) -> Floats:
    """(6, 6) Fisher information of T_lidar_target, rotation first, right perturbation; see `covariance_bound`.

    Raises:
        InputError: the azimuth step is not known, or the sensor is not on the target's -x side.
    """
    if sensor.azimuth_step is None:
        raise InputError(f"sensor '{sensor.name}': its azimuth step has to be known for a bound")
    rays = _rays(target, sensor, T_lidar_target)
    n_edge, q_edge, ray_edge, ring_edge, s_edge = _ring_ends(target, rays)
    n_plane = np.broadcast_to([1.0, 0.0, 0.0], (int(rays.inside.sum()), 3))

    normals = np.concatenate([n_edge, n_plane])
    points = np.concatenate([q_edge, rays.points[rays.inside]])
    beams = np.concatenate([ray_edge, rays.directions[rays.inside]])
    ring = np.concatenate([ring_edge, np.nonzero(rays.inside)[0]])
    # Moving the target by (omega, v) moves a point on it, held in space, by -(omega x q + v) relative to it.
    J = np.hstack([np.cross(points, normals), normals])
    per_range = (beams * normals).sum(axis=1)
    variance = (per_range * sensor.range_noise) ** 2
    variance += (_by_azimuth(points, normals, T_lidar_target) * azimuth_noise) ** 2
    width = np.zeros(len(points))
    to_edge = q_edge + T_lidar_target[:3, :3].T @ T_lidar_target[:3, 3]
    width[: len(n_edge)] = sensor.beam_aperture + sensor.beam_divergence * np.linalg.norm(to_edge, axis=1)
    variance[: len(n_edge)] += ((s_edge * n_edge).sum(axis=1) * sensor.azimuth_step) ** 2 / 12.0
    variance += width**2 / 12.0
    # A noiseless row would be infinitely informative; a micrometre is as good as none.
    weight = 1.0 / (variance + 1e-12)

    # What rows share: a bias of each ring, and an offset of all ring ends, each in its own standard deviations.
    shared = np.zeros((len(points), sensor.n_rings + 1))
    shared[np.arange(len(points)), ring] = per_range * sensor.ring_bias
    shared[:, -1] = width / np.sqrt(12.0)
    # Eliminated (Schur complement).
    across = shared.T @ (weight[:, None] * J)
    own = shared.T @ (weight[:, None] * shared) + np.eye(sensor.n_rings + 1)
    return np.asarray(J.T @ (weight[:, None] * J) - across.T @ np.linalg.solve(own, across))


def _by_azimuth(points: Floats, normals: Floats, T_lidar_target: Floats) -> Floats:
    """(N,) how far a radian of azimuth moves points along normals, metres; both in the target frame."""
    R, t = T_lidar_target[:3, :3], T_lidar_target[:3, 3]
    return np.asarray((np.cross(R[2], points + R.T @ t) * normals).sum(axis=1))


@dataclass(frozen=True, eq=False, repr=False)
class _Rays(Value):
    """Rays of all rings over the target's azimuths: (R, A) of them, in the target frame.

    Attributes:
        points: (R, A, 3) where they meet the target's plane.
        directions: (R, A, 3) unit vectors.
        outside: (R, A) signed distance outside the target, metres.
        inside: (R, A) whether they hit the target.
        step: rad between two.
    """

    points: Floats
    directions: Floats
    outside: Floats
    inside: Bools
    step: float


def _rays(target: Target, sensor: SensorModel, T_lidar_target: Floats) -> _Rays:
    assert sensor.azimuth_step is not None
    R, t = T_lidar_target[:3, :3], T_lidar_target[:3, 3]
    corners = target.vertices @ R.T + t
    middle = np.arctan2(t[1], t[0])
    spread = np.angle(np.exp(1j * (np.arctan2(corners[:, 1], corners[:, 0]) - middle)))
    step = sensor.azimuth_step
    azimuths = middle + np.arange(spread.min() - 1.5 * step, spread.max() + 1.5 * step, step)
    cos_e, sin_e = np.cos(sensor.elevations)[:, None], np.sin(sensor.elevations)[:, None]
    beams = np.stack(
        [cos_e * np.cos(azimuths), cos_e * np.sin(azimuths), np.broadcast_to(sin_e, (len(cos_e), len(azimuths)))],
        axis=-1,
    )
    directions, origin = beams @ R, -R.T @ t
    if origin[0] >= 0 or (directions[..., 0] <= 1e-6).any():
        raise InputError(f"target '{target.name}': the sensor is not on its -x side, in front of its plane")
    points = origin + directions * (-origin[0] / directions[..., 0])[..., None]
    outside = target.outside_distance(points[..., 1:].reshape(-1, 2)).reshape(points.shape[:2])
    return _Rays(points, directions, outside, outside < 0, step)


def _ring_ends(target: Target, rays: _Rays) -> tuple[Floats, Floats, Floats, Ints, Floats]:
    """Where rings enter and leave the target: outward normals, points, beams, rings, in-plane metres per radian."""
    ring, column = np.nonzero(rays.inside[:, 1:] != rays.inside[:, :-1])
    a, b = rays.points[ring, column], rays.points[ring, column + 1]
    before, after = rays.outside[ring, column], rays.outside[ring, column + 1]
    share = (before / (before - after))[:, None]
    points = a + share * (b - a)
    edge = (points[:, 1:] @ target.normals.T - target.offsets).argmax(axis=1)
    normals = np.column_stack([np.zeros(len(edge)), target.normals[edge]])
    return normals, points, rays.directions[ring, column], ring, (b - a) / rays.step
