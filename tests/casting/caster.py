"""Cast finite beams at a convex target and a wall behind it, and keep the strongest (or first) return of each.

A beam is a bundle of sub-rays that fills the disc of its aperture and spreads by its divergence. Each sub-ray brings
back energy from what it meets: reflectivity times the cosine of incidence, over the range squared. What counts as a
return is decided by the receiver, so nothing here knows of edges, offsets across them, or probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target


@dataclass(frozen=True)
class Receiver:
    """What decides which returns there are, and how they are measured.

    Attributes:
        threshold: least energy of a return, as a share of that of a beam wholly on the target.
        threshold_noise: standard deviation of the threshold from ray to ray.
        first: report the nearest return above the threshold instead of the strongest.
        azimuth_jitter: standard deviation of a reported azimuth about the fired one, rad.
        range_noise: standard deviation of one range, metres.
        ring_bias: standard deviation of a ring's range bias, metres.
        mixed: probability that a beam split between target and wall is reported between them.
        brightness: range bias of all returns of the target, metres: early or late pulses.
        glow: share of a beam's energy in a halo around it, four times as wide: what makes bright targets bloom.
    """

    threshold: float = 0.5
    threshold_noise: float = 0.02
    first: bool = False
    azimuth_jitter: float = 0.0
    range_noise: float = 0.0
    ring_bias: float = 0.0
    mixed: float = 0.0
    brightness: float = 0.0
    glow: float = 0.0


@dataclass(frozen=True)
class Wall:
    """A wall behind the target, facing the sensor.

    Attributes:
        gap: how far behind the target's origin, metres.
        reflectivity: relative to the target's.
    """

    gap: float
    reflectivity: float = 0.5


def firing_phases(sensor: SensorModel) -> np.ndarray:
    """(R,) azimuth at which each ring fires within its column, in steps, for the firing orders that makers publish.

    VLP-16: one laser every 2.304 us of 55.296 us, the lower half of the rings in the even slots. VLP-32C: pairs, in
    the order of its manual. OS1: all at once, four staggered columns of beams (±1.05 and ±3.16 deg). Others: at once.
    """
    rings = np.arange(sensor.n_rings)
    if sensor.name.startswith("vlp16"):
        return np.where(rings < 8, 2 * rings, 2 * (rings - 8) + 1) * (2.304 / 55.296)
    if sensor.name.startswith("vlp32"):
        order = [-25, -1, -1.667, -15.639, -11.31, 0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333, 1.333,
                 0.667, -4, -4.667, 1.667, 1, -3.667, -3.333, 3.333, 2.333, -2.667, -3, 7, 4.667, -2.333, -2, 15,
                 10.333, -1.333]  # fmt: skip
        slot = np.empty(len(order))
        slot[np.argsort(order)] = np.arange(len(order)) // 2
        return slot * (2.304 / 55.296)
    if sensor.name.startswith("os1"):
        assert sensor.azimuth_step is not None
        return np.radians(np.array([3.16, 1.05, -1.05, -3.16])[rings % 4]) / sensor.azimuth_step % 1.0
    return np.zeros(sensor.n_rings)


def disc(rings: int = 3) -> np.ndarray:
    """(K, 2) points that fill a unit disc evenly: a centre and `rings` circles of 6, 12, 18 ... points."""
    points = [np.zeros((1, 2))]
    for k in range(1, rings + 1):
        angle = 2 * np.pi * (np.arange(6 * k) + 0.5 * (k % 2)) / (6 * k)
        points.append(k / (rings + 0.5) * np.column_stack([np.cos(angle), np.sin(angle)]))
    return np.vstack(points)


def cast(
    target: Target,
    sensor: SensorModel,
    T_lidar_target: np.ndarray,
    receiver: Receiver,
    rng: np.random.Generator,
    wall: Wall | None = None,
) -> tuple[Scan, np.ndarray]:
    """Cast one revolution at a target.

    Args:
        target: a convex polygon.
        sensor: whose beams; elevations, azimuth step, divergence and aperture are used.
        T_lidar_target: (4, 4).
        receiver: what decides.
        rng: source of randomness.
        wall: what is behind, if anything.

    Returns:
        The returns, and (N,) whether each is of the target.
    """
    ring, azimuth = _rays_near(target, sensor, T_lidar_target, rng)
    elevation = sensor.elevations[ring]
    axis = np.column_stack(_unit(azimuth, elevation))
    left = np.column_stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(azimuth))])
    up = np.cross(axis, left)
    across = disc()[None, :, :1] * left[:, None] + disc()[None, :, 1:] * up[:, None]  # (N, K, 3)

    def meet(width: float) -> tuple[np.ndarray, np.ndarray]:
        """(N,) share of the sub-rays of beams so many times as wide that meet the target, and their mean range."""
        origin = 0.5 * sensor.beam_aperture * across
        direction = axis[:, None] + 0.5 * width * sensor.beam_divergence * across
        reach = ((t - origin) @ normal) / (direction @ normal)
        met = (origin + reach[..., None] * direction - t) @ R[:, 1:]
        on = reach > 0
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            on &= (b[0] - a[0]) * (met[..., 1] - a[1]) - (b[1] - a[1]) * (met[..., 0] - a[0]) >= 0
        ranges = np.where(on.any(axis=1), (reach * on).sum(axis=1) / np.maximum(on.sum(axis=1), 1), np.inf)
        return on.mean(axis=1), ranges

    R, t, corners = T_lidar_target[:3, :3], T_lidar_target[:3, 3], target.polygon
    normal = R[:, 0]
    full = np.abs(axis @ normal) / np.linalg.norm(t) ** 2
    share, at_target = meet(1.0)
    energy = share  # of a beam wholly on the target
    if receiver.glow > 0:
        around, at_rim = meet(4.0)
        energy = (1 - receiver.glow) * share + receiver.glow * around
        at_target = np.where(share > 0, at_target, at_rim)
    far, beyond = np.full(len(ring), np.inf), np.zeros(len(ring))
    if wall is not None:
        bearing = t / np.linalg.norm(t)
        far = (t @ bearing + wall.gap) / (axis @ bearing)
        beyond = (1 - share) * wall.reflectivity * (axis @ bearing) / far**2 / full

    level = receiver.threshold + receiver.threshold_noise * rng.normal(size=len(ring))
    seen, behind = energy > np.maximum(level, 1e-9), beyond > np.maximum(level, 1e-9)
    wins = seen & (~behind | receiver.first | (energy >= beyond))
    ranges = np.where(wins, at_target, far)
    both = seen & (beyond > 0) & (share < 1) & (rng.uniform(size=len(ring)) < receiver.mixed)
    weight = energy / np.maximum(energy + beyond, 1e-300)
    if both.any():
        ranges[both] = weight[both] * at_target[both] + (1 - weight[both]) * far[both]

    kept = np.flatnonzero(wins | behind)
    ring, ranges = ring[kept], ranges[kept]
    bias = receiver.ring_bias * rng.normal(size=sensor.n_rings)
    ranges = ranges + bias[ring] + receiver.brightness * wins[kept] + receiver.range_noise * rng.normal(size=len(ring))
    reported = azimuth[kept] + receiver.azimuth_jitter * rng.normal(size=len(ring))
    points = ranges[:, None] * np.column_stack(_unit(reported, elevation[kept]))
    return Scan(points, ring, sensor=sensor, name="cast"), wins[kept]


def _unit(azimuth: np.ndarray, elevation: np.ndarray) -> list[np.ndarray]:
    flat = np.cos(elevation)
    return [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]


def _rays_near(
    target: Target, sensor: SensorModel, T_lidar_target: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Ring and azimuth of every ray fired within a few beams of the target, in one revolution of random phase."""
    assert sensor.azimuth_step is not None
    corners = target.vertices @ T_lidar_target[:3, :3].T + T_lidar_target[:3, 3]
    # Points along the outline: in angles, edges bulge beyond their corners.
    outline = corners[:, None] + np.linspace(0, 1, 20)[:, None] * (np.roll(corners, -1, axis=0) - corners)[:, None]
    x, y, z = outline.reshape(-1, 3).T
    middle = np.arctan2(T_lidar_target[1, 3], T_lidar_target[0, 3])
    aside = (np.arctan2(y, x) - middle + np.pi) % (2 * np.pi) - np.pi
    height = np.arctan2(z, np.hypot(x, y))
    slack = sensor.beam_divergence + sensor.beam_aperture / np.linalg.norm(outline.reshape(-1, 3), axis=1).min() + 1e-3
    rings = np.flatnonzero((sensor.elevations > height.min() - slack) & (sensor.elevations < height.max() + slack))
    step, phases = sensor.azimuth_step, firing_phases(sensor) + rng.uniform()
    low, high = (middle + aside.min() - slack) / step, (middle + aside.max() + slack) / step
    columns = np.arange(np.floor(low) - 1, np.ceil(high) + 2)
    ring, azimuth = np.repeat(rings, len(columns)), (columns + phases[rings, None]).ravel() * step
    return ring, azimuth
