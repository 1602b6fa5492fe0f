"""Furnished rooms, scanned by a ray caster that shares no code with the package's simulator.

A beam is seven rays over its width. It returns the mean range of the largest group of them that agree, so edges give
mixed returns. Ranges have noise and a bias for each ring, azimuths jitter, some returns are lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph import Scan, SensorModel
from optshape_graph.simulation import pose_from_rpy

RAYS = 0.45 * np.array([[0.0, 0.0], *([np.cos(a), np.sin(a)] for a in np.arange(6) * np.pi / 3)])
"""Directions of a beam's rays, in beam widths from its middle."""

AGREE = 0.25
"""Metres between the ranges of two rays whose light the receiver can't tell apart."""


@dataclass(frozen=True)
class Solid:
    """A box, a cylinder about z or an ellipsoid in the box of its size, or a convex plate in the plane x = 0."""

    kind: str
    size: np.ndarray
    T: np.ndarray
    polygon: np.ndarray | None = None

    @property
    def radius(self) -> float:
        """Of a sphere about its origin that holds it."""
        if self.polygon is not None:
            return float(np.linalg.norm(self.polygon, axis=1).max())
        return float(np.linalg.norm(self.size) / 2)

    def cast(self, directions: np.ndarray) -> np.ndarray:
        """(N,) range at which rays (N, 3) from the origin meet it first, infinite where they don't."""
        R, t = self.T[:3, :3], self.T[:3, 3]
        o, d = -R.T @ t, directions @ R
        d = np.where(np.abs(d) < 1e-12, 1e-12, d)
        with np.errstate(invalid="ignore"):
            near, far = getattr(self, f"_{self.kind}")(o, d)
            ranges = np.where(near > 1e-6, near, far)
            return np.where((near <= far) & (ranges > 1e-6), ranges, np.inf)

    def _slab(self, o: np.ndarray, d: np.ndarray, axes: list[int]) -> tuple[np.ndarray, np.ndarray]:
        sides = (np.array([-0.5, 0.5])[:, None] * self.size - o)[:, axes]
        ranges = np.sort(sides[:, None] / d[:, axes], axis=0)
        return ranges[0].max(axis=1), ranges[1].min(axis=1)

    def _box(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._slab(o, d, [0, 1, 2])

    def _quadric(self, o: np.ndarray, d: np.ndarray, axes: list[int]) -> tuple[np.ndarray, np.ndarray]:
        scale = 0.5 * self.size[axes]
        p, v = o[axes] / scale, d[:, axes] / scale
        a, b, c = (v**2).sum(axis=1), v @ p, p @ p - 1.0
        root = np.sqrt(b**2 - a * c)
        return (-b - root) / a, (-b + root) / a

    def _ellipsoid(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._quadric(o, d, [0, 1, 2])

    def _cylinder(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        round_side, ends = self._quadric(o, d, [0, 1]), self._slab(o, d, [2])
        return np.maximum(round_side[0], ends[0]), np.minimum(round_side[1], ends[1])

    def _plate(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ranges = -o[0] / d[:, 0]
        at = o[1:] + ranges[:, None] * d[:, 1:]
        corner, side = self.polygon, np.roll(self.polygon, -1, axis=0) - self.polygon
        left = side[:, 0] * (at[:, None, 1] - corner[:, 1]) - side[:, 1] * (at[:, None, 0] - corner[:, 0])
        hit = (left >= 0).all(axis=1) | (left <= 0).all(axis=1)
        return np.where(hit, ranges, np.nan), ranges


def box(size, *pose) -> Solid:
    """A box of a size at a pose: x, y, z and roll, pitch, yaw in radians."""
    return Solid("box", np.asarray(size, float), pose_from_rpy(pose[:3], pose[3:] or (0.0, 0.0, 0.0)))


def plate(polygon, T: np.ndarray) -> Solid:
    """A thin plate of a convex shape (n, 2)."""
    return Solid("plate", np.zeros(3), T, np.asarray(polygon, float))


def scan_room(solids: list[Solid], sensor: SensorModel, rng: np.random.Generator, noise: float = 0.01) -> Scan:
    """One revolution of a sensor at the origin."""
    step = sensor.azimuth_step or np.radians(0.2)
    columns = round(2 * np.pi / step)
    azimuth = -np.pi + step * (np.arange(columns) + rng.uniform()) + rng.normal(0, 3e-4, (sensor.n_rings, columns))
    elevation = np.repeat(sensor.elevations[:, None], columns, axis=1)
    shape = azimuth.shape
    azimuth, elevation = azimuth.ravel(), elevation.ravel()
    ranges, hit = _first_hit(solids, azimuth, elevation)
    of = hit.reshape(shape)
    edge = np.zeros(shape, bool)
    for axis in (0, 1):
        differs = np.diff(of, axis=axis, append=of.take([0 if axis else -1], axis=axis)) != 0
        edge |= differs | np.roll(differs, 1, axis=axis)
    split = np.flatnonzero(edge)
    width = sensor.beam_divergence
    rays = [_first_hit(solids, azimuth[split] + width * a, elevation[split] + width * e)[0] for a, e in RAYS]
    ranges[split] = _strongest(np.sort(np.array(rays).T, axis=1))
    keep = np.isfinite(ranges) & (rng.uniform(size=len(ranges)) > 0.01)
    ring = np.repeat(np.arange(sensor.n_rings), columns)
    bias = rng.normal(0, 0.5 * noise, sensor.n_rings)
    measured = (ranges + bias[ring] + rng.normal(0, noise, len(ranges)))[keep]
    directions = _directions(azimuth[keep], elevation[keep])
    return Scan(measured[:, None] * directions, ring=ring[keep], sensor=sensor, name="room")


def _directions(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def _first_hit(solids: list[Solid], azimuth: np.ndarray, elevation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    directions = _directions(azimuth, elevation)
    ranges, of = np.full(len(azimuth), np.inf), np.full(len(azimuth), -1)
    for k, solid in enumerate(solids):
        away = np.linalg.norm(solid.T[:3, 3])
        rows = np.arange(len(azimuth))
        if away > solid.radius:
            cosine = np.sqrt(1 - (solid.radius / away) ** 2)
            rows = np.flatnonzero(directions @ (solid.T[:3, 3] / away) >= cosine)
        found = solid.cast(directions[rows])
        nearer = found < ranges[rows]
        ranges[rows[nearer]], of[rows[nearer]] = found[nearer], k
    return ranges, of


def _strongest(sorted_ranges: np.ndarray) -> np.ndarray:
    """(N,) mean range of the largest group among sorted ranges (N, K) whose neighbours agree."""
    with np.errstate(invalid="ignore"):
        group = np.cumsum(np.diff(sorted_ranges, axis=1, prepend=sorted_ranges[:, :1]) > AGREE, axis=1)
    group = np.where(np.isfinite(sorted_ranges), group, -1)
    best, most = np.full(len(group), np.inf), np.zeros(len(group))
    for k in range(group.shape[1]):
        member = group == k
        count = member.sum(axis=1)
        mean = np.where(member, sorted_ranges, 0.0).sum(axis=1) / np.maximum(count, 1)
        larger = count > most
        best[larger], most[larger] = mean[larger], count[larger]
    return best


def furnished_room(rng: np.random.Generator, n_boxes: int = 20) -> list[Solid]:
    """Walls, one of them with an opening, boxes of many sizes and orientations, tables, columns, signs and people."""
    size = rng.uniform([8, 8, 2.6], [30, 20, 6])
    floor = -rng.uniform(0.5, 2.0)
    centre = rng.uniform(-0.35, 0.35, 2) * size[:2]
    things = [box(size, *centre, floor + size[2] / 2)]

    def place(nearest: float = 1.5) -> np.ndarray:
        while True:
            at = centre + rng.uniform(-0.48, 0.48, 2) * size[:2]
            if np.linalg.norm(at) > nearest:
                return at

    for k in range(n_boxes):
        sides = rng.uniform(0.2, 1.6, 3)
        x, y = place()
        if k % 3 == 2:  # held up by something that isn't seen
            things.append(box(sides, x, y, rng.uniform(floor + 0.5, floor + 2.5), *rng.uniform(-np.pi, np.pi, 3)))
        else:
            things.append(box(sides, x, y, floor + sides[2] / 2, 0, 0, rng.uniform(0, np.pi)))
    for _ in range(3):
        (x, y), (a, b), height, turn = place(), rng.uniform(0.6, 2.0, 2), rng.uniform(0.5, 1.1), rng.uniform(0, np.pi)
        things.append(box([a, b, 0.04], x, y, floor + height, 0, 0, turn))
        for u, v in ((-0.45, -0.45), (-0.45, 0.45), (0.45, -0.45), (0.45, 0.45)):
            leg = np.array([np.cos(turn) * u * a - np.sin(turn) * v * b, np.sin(turn) * u * a + np.cos(turn) * v * b])
            things.append(box([0.05, 0.05, height], x + leg[0], y + leg[1], floor + height / 2, 0, 0, turn))
    for _ in range(4):
        (x, y), width, height = place(), rng.uniform(0.2, 1.2), rng.uniform(0.5, 2.5)
        things.append(
            Solid("cylinder", np.array([width, width, height]), pose_from_rpy([x, y, floor + height / 2], [0, 0, 0]))
        )
    for _ in range(3):
        (x, y), corners = place(), int(rng.choice([4, 4, 8, 16]))
        angle = np.arange(corners) * 2 * np.pi / corners + np.pi / corners
        polygon = np.column_stack([np.cos(angle), np.sin(angle)]) * rng.uniform(0.25, 0.9, 2)
        height, turn = rng.uniform(1.0, 2.2), rng.uniform(-0.8, 0.8)
        things.append(plate(polygon, pose_from_rpy([x, y, floor + height], [0, 0, np.arctan2(y, x) + turn])))
        behind = 0.05 * np.array([np.cos(np.arctan2(y, x) + turn), np.sin(np.arctan2(y, x) + turn)])
        things.append(box([0.05, 0.05, height], x + behind[0], y + behind[1], floor + height / 2))
    for _ in range(3):
        x, y = place()
        things.append(Solid("ellipsoid", np.array([0.5, 0.35, 1.8]), pose_from_rpy([x, y, floor + 0.9], [0, 0, 0])))
    things += _wall_with_opening(rng, place(3.0), floor, size[2])
    return things


def _wall_with_opening(rng: np.random.Generator, at: np.ndarray, floor: float, height: float) -> list[Solid]:
    """A wall 4 m wide about a door or a window."""
    wide, low, high = rng.uniform(0.7, 1.3), rng.choice([0.0, 0.9]), rng.uniform(1.8, 2.2)
    turn = np.arctan2(at[1], at[0]) + rng.uniform(-0.8, 0.8)
    frame = pose_from_rpy([*at, floor], [0, 0, turn])
    side = 2.0 - wide / 2
    pieces = [(side, height, s * (wide / 2 + side / 2), height / 2) for s in (-1, 1)]
    pieces += [(wide, low, 0.0, low / 2)] if low > 0 else []
    pieces += [(wide, height - high, 0.0, (height + high) / 2)]
    return [Solid("box", np.array([0.1, b, c]), frame @ pose_from_rpy([0, y, z], [0, 0, 0])) for b, c, y, z in pieces]
