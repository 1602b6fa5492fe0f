"""Scans that break an assumption of the estimator, each in one known way, with the true pose.

A clean scan comes from the package's simulator or from a ray caster that shares no code with it; what is broken is done
to its returns, or to the target, the sensor and the motion that it is cast with. Kinds and sizes are those that users
were seen to record.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from optshape_graph import Scan, SensorModel, Target
from optshape_graph.se3 import inverse
from optshape_graph.simulation import (
    ConstantTwist,
    NoiseModel,
    Patch,
    Scene,
    pose_from_rpy,
    simulate,
    simulate_target,
)

Cast = Callable[[Target, SensorModel, np.ndarray, np.random.Generator], Scan]
Surface = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class World:
    """Where scans are drawn: a target and a sensor, ranges in metres, and what casts."""

    target: Target
    sensor: SensorModel
    ranges: tuple[float, float]
    cast: Cast

    def draw(self, rng: np.random.Generator) -> Trial:
        """A clean scan of at least 20 returns on at least two rings."""
        while True:
            T = pose_from_rpy(
                [rng.uniform(*self.ranges), *rng.uniform(-0.3, 0.3, 2)], np.radians(rng.uniform(-35.0, 35.0, 3))
            )
            scan = self.cast(self.target, self.sensor, T, rng)
            if len(scan) >= 20 and len(np.unique(scan.ring)) >= 2:
                return Trial(scan, self.target, (T,), self)


@dataclass(frozen=True)
class Trial:
    """What the estimator is given, and the true poses: several where any of them is right."""

    scan: Scan
    target: Target
    T_lidar_target: tuple[np.ndarray, ...]
    world: World

    @property
    def T(self) -> np.ndarray:
        return self.T_lidar_target[0]

    def with_points(self, points: np.ndarray) -> Trial:
        return replace(self, scan=replace(self.scan, points=points))

    def keep(self, mask: np.ndarray) -> Trial:
        return replace(self, scan=self.scan.select(np.flatnonzero(mask)))

    def cast(self, target: Target, sensor: SensorModel, rng: np.random.Generator) -> Trial:
        """The same placement seen again, by another sensor or of another board; the estimator is not told."""
        scan = self.world.cast(target, sensor, self.T, rng)
        return replace(self, scan=replace(scan, sensor=self.scan.sensor))

    @property
    def at_target(self) -> np.ndarray:
        """(N, 3) returns in the target's frame."""
        T = inverse(self.T)
        return np.asarray(self.scan.points @ T[:3, :3].T + T[:3, 3])


def by_simulator(target: Target, sensor: SensorModel, T: np.ndarray, rng: np.random.Generator) -> Scan:
    """The package's simulator, noise as the sensor's file says."""
    return simulate_target(target, sensor, T, noise=NoiseModel.of(sensor), rng=rng)


def on_surface(trial: Trial, height: Surface) -> Trial:
    """Move every return along its ray from the plane x = 0 onto x = height(y, z), its own noise kept."""
    y, T = trial.at_target, inverse(trial.T)
    ranges = np.linalg.norm(trial.scan.points, axis=1)
    ray = trial.scan.points / ranges[:, None] @ T[:3, :3].T
    further = np.zeros(len(y))
    for _ in range(5):
        further = height((y + further[:, None] * ray)[:, 1:]) / ray[:, 0]
    return trial.with_points(trial.scan.points * (1.0 + further / ranges)[:, None])


def _direction(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def folded(trial: Trial, rng: np.random.Generator, degrees: float) -> Trial:
    """Along a line near the middle; the true pose is that of one half."""
    n, where = _direction(rng), rng.uniform(-0.15, 0.15) * trial.target.circumradius
    return on_surface(trial, lambda q: np.tan(np.radians(degrees)) * np.maximum(q @ n - where, 0.0))


def bent(trial: Trial, rng: np.random.Generator, sag: float) -> Trial:
    """A cylinder, its middle that far behind its ends, whose plane is the true one."""
    n, side = _direction(rng), rng.choice([-1.0, 1.0])
    along = trial.target.polygon @ n
    middle, reach = (along.max() + along.min()) / 2, np.ptp(along) / 2
    return on_surface(trial, lambda q: side * sag * (1.0 - ((q @ n - middle) / reach) ** 2))


def framed(trial: Trial, rng: np.random.Generator, height: float) -> Trial:
    """A rim of 6 cm that stands out towards the sensor."""
    return on_surface(trial, lambda q: np.where(trial.target.outside_distance(q) > -0.06, -height, 0.0))


def merged(trial: Trial, rng: np.random.Generator, distance: float) -> Trial:
    """Two revolutions, the target moved in between: either pose is right, and so is that in the middle."""
    way = rng.normal(size=3)
    step = np.eye(4)
    step[:3, 3] = distance * way / np.linalg.norm(way)
    half = step.copy()
    half[:3, 3] /= 2
    other = trial.world.cast(trial.target, trial.world.sensor, step @ trial.T, rng)
    both = _appended(trial.scan, other.points, other.ring)
    return replace(trial, scan=both, T_lidar_target=(trial.T, step @ trial.T, half @ trial.T))


def _appended(scan: Scan, points: np.ndarray, ring: np.ndarray) -> Scan:
    return Scan(np.vstack([scan.points, points]), np.concatenate([scan.ring, ring]), sensor=scan.sensor, name=scan.name)


HAND = Target.from_polygon([(-0.06, -0.09), (0.06, -0.09), (0.06, 0.09), (-0.06, 0.09)], "hand")


def held(trial: Trial, rng: np.random.Generator, before: float) -> Trial:
    """A hand of 12 by 18 cm about the middle of an edge, so far in front of it, taken for a part of the target."""
    vertices, k, seed = trial.target.vertices, rng.integers(len(trial.target)), rng.integers(2**32)
    at_hand = np.eye(4)
    at_hand[:3, 3] = (vertices[k] + vertices[k - 1]) / 2 - [before, 0.0, 0.0]
    board, hand = (  # the same firings
        trial.world.cast(target, trial.world.sensor, T, np.random.default_rng(seed))
        for target, T in ((trial.target, trial.T), (HAND, trial.T @ at_hand))
    )
    to_hand = inverse(trial.T @ at_hand)
    ray, start = board.points @ to_hand[:3, :3].T, to_hand[:3, 3]
    hidden = HAND.outside_distance((start - ray * (start[0] / ray[:, :1]))[:, 1:]) < 0
    return replace(trial, scan=_appended(board.select(np.flatnonzero(~hidden)), hand.points, hand.ring))


def _ends(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """(M,) rows of the ends of rings, and +1 for left ones, -1 for right ones."""
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    rows, sides = [], []
    for ring in np.unique(scan.ring):
        of = np.flatnonzero(scan.ring == ring)
        rows += [of[azimuth[of].argmax()], of[azimuth[of].argmin()]]
        sides += [1, -1]
    return np.array(rows), np.array(sides)


def _turned(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1], points[:, 2]])


def mixed(trial: Trial, rng: np.random.Generator, count: int) -> Trial:
    """So many firings beyond each end return from between the target and what is 0.3 m behind it."""
    rows, sides = _ends(trial.scan)
    scan, step = trial.scan, trial.world.sensor.azimuth_step
    points, rings = [], []
    for k in range(1, count + 1):
        further = 1.0 + rng.uniform(0.0, 0.3, len(rows)) / np.linalg.norm(scan.points[rows], axis=1)
        points.append(_turned(scan.points[rows] * further[:, None], sides * k * step))
        rings.append(scan.ring[rows])
    return replace(trial, scan=_appended(scan, np.vstack(points), np.concatenate(rings)))


def ends_behind(trial: Trial, rng: np.random.Generator, depth: float) -> Trial:
    """The last returns of every ring are up to so far behind."""
    rows, _ = _ends(trial.scan)
    points = trial.scan.points.copy()
    rows = np.unique(rows)
    points[rows] *= 1.0 + (rng.uniform(0.0, depth, len(rows)) / np.linalg.norm(points[rows], axis=1))[:, None]
    return trial.with_points(points)


def moving(trial: Trial, rng: np.random.Generator, speed: float) -> Trial:
    """The sensor drives, nothing is deskewed; the true pose is that when the middle of the target was hit."""
    angle = rng.uniform(0, 2 * np.pi)
    velocity = np.array([0.0, 0.0, 0.0, speed * np.cos(angle), speed * np.sin(angle), 0.0])
    sensor = trial.world.sensor
    ahead = ConstantTwist(np.eye(4), velocity)
    time = float(np.mean(trial.scan.time)) if trial.scan.time is not None else 0.05
    _, t = ahead.at(np.array([time]))
    then = np.eye(4)
    then[:3, 3] = t[0]
    T_world_target = then @ trial.T  # where it is, as the sensor sees it when it passes
    seen = simulate(Scene((Patch(trial.target, T_world_target),)), sensor, ahead, noise=NoiseModel.of(sensor), rng=rng)
    return replace(trial, scan=seen.scan)


def elsewhere(trial: Trial, rng: np.random.Generator) -> Trial:
    """Returns in the frame of a vehicle, half a metre to two from the sensor and tilted, no sensor named."""
    X = pose_from_rpy(rng.uniform(0.3, 1.2, 3) * rng.choice([-1, 1], 3), np.radians(rng.uniform(-20, 20, 3)))
    points = trial.scan.points @ X[:3, :3].T + X[:3, 3]
    return replace(trial, scan=Scan(points, trial.scan.ring), T_lidar_target=(X @ trial.T,))


def cut(trial: Trial, rng: np.random.Generator, share: float) -> Trial:
    """The left part of the field of view is missing."""
    azimuth = np.arctan2(trial.scan.points[:, 1], trial.scan.points[:, 0])
    return trial.keep(azimuth <= azimuth.max() - share * np.ptp(azimuth))


def noisier(trial: Trial, rng: np.random.Generator, noise: float, bias: float) -> Trial:
    """Ranges or rings err so many times as much as the file says."""
    sensor = trial.world.sensor
    worse = replace(sensor, range_noise=noise * sensor.range_noise, ring_bias=bias * sensor.ring_bias)
    return trial.cast(trial.target, worse, rng)


def brighter(trial: Trial, rng: np.random.Generator, times: float) -> Trial:
    """The board's brightness does so many times as much to its ranges and its rim as the file says."""
    sensor = trial.world.sensor
    bright = replace(sensor, brightness_bias=times * sensor.brightness_bias, blooming=times * sensor.blooming)
    return trial.cast(trial.target, bright, rng)


def resized(trial: Trial, rng: np.random.Generator, along: float, across: float) -> Trial:
    """The board is larger than its file says, along a random direction and across it."""
    n = _direction(rng)
    S = across * np.eye(2) + (along - across) * np.outer(n, n)
    return trial.cast(Target.from_polygon(trial.target.polygon @ S.T, "as cut"), trial.world.sensor, rng)


def few_rings(trial: Trial, rng: np.random.Generator, count: int) -> Trial:
    """So many neighbouring rings are left of a crop."""
    rings = np.unique(trial.scan.ring)
    first = rng.integers(0, max(len(rings) - count, 0) + 1)
    return trial.keep(np.isin(trial.scan.ring, rings[first : first + count]))


def mirrored(trial: Trial, rng: np.random.Generator) -> Trial:
    """The board is hung with its back to the front, and the cloud has no rings."""
    polygon = trial.target.polygon[::-1] * [-1.0, 1.0]
    seen = trial.cast(Target.from_polygon(polygon, "back"), trial.world.sensor, rng)
    return replace(seen, scan=replace(seen.scan, ring=None))


def ringless(trial: Trial, rng: np.random.Generator) -> Trial:
    return replace(trial, scan=replace(trial.scan, ring=None))


def chequered(trial: Trial, rng: np.random.Generator, further: float) -> Trial:
    """Dark squares of 10 cm return too late."""
    y = trial.at_target
    dark = (np.floor(y[:, 1] / 0.1) + np.floor(y[:, 2] / 0.1)) % 2 == 0
    factor = 1.0 + dark * further / np.linalg.norm(trial.scan.points, axis=1)
    return trial.with_points(trial.scan.points * factor[:, None])


def duplicated(trial: Trial, rng: np.random.Generator) -> Trial:
    """A dual-return driver reports every return twice."""
    return replace(trial, scan=_appended(trial.scan, trial.scan.points, trial.scan.ring))


def lost(trial: Trial, rng: np.random.Generator, share: float) -> Trial:
    """Firings that return nothing."""
    return trial.keep(rng.uniform(size=len(trial.scan)) >= share)


def strays(trial: Trial, rng: np.random.Generator, count: int, reach: float = 0.3) -> Trial:
    """A few returns beside the target, up to so far beyond the end of a ring, within 5 cm of the plane's range."""
    rows, sides = _ends(trial.scan)
    of = rng.choice(len(rows), min(count, len(rows)), replace=False)
    ranges = np.linalg.norm(trial.scan.points[rows[of]], axis=1)
    further = 1.0 + rng.uniform(-0.05, 0.05, len(of)) / ranges
    beside = _turned(
        trial.scan.points[rows[of]] * further[:, None], sides[of] * rng.uniform(0.05, reach, len(of)) / ranges
    )
    return replace(trial, scan=_appended(trial.scan, beside, trial.scan.ring[rows[of]]))


def bad_day(trial: Trial, rng: np.random.Generator) -> Trial:
    """An ordinary one: rings 2 cm apart, a bend of 5 mm, 1.5 % too large or small, a tenth lost, two strays."""
    sensor = trial.world.sensor
    size = 1.0 + 0.015 * rng.choice([-1, 1])
    seen = trial.cast(trial.target.scaled(size), replace(sensor, ring_bias=0.02), rng)
    return strays(lost(bent(seen, rng, 0.005), rng, 0.1), rng, 2)


KINDS: dict[str, Callable[[Trial, np.random.Generator], Trial]] = {
    "folded 5 deg": lambda t, r: folded(t, r, 5.0),
    "two scans 5 cm apart": lambda t, r: merged(t, r, 0.05),
    "two scans 10 cm apart": lambda t, r: merged(t, r, 0.10),
    "hand 4 cm in front": lambda t, r: held(t, r, 0.04),
    "hand 8 cm in front": lambda t, r: held(t, r, 0.08),
    "mixed pixels 1": lambda t, r: mixed(t, r, 1),
    "mixed pixels 2": lambda t, r: mixed(t, r, 2),
    "mixed pixels 3": lambda t, r: mixed(t, r, 3),
    "ends 30 cm behind": lambda t, r: ends_behind(t, r, 0.3),
    "frame raised 3 cm": lambda t, r: framed(t, r, 0.03),
    "bent 5 cm": lambda t, r: bent(t, r, 0.05),
    "bent 2 cm": lambda t, r: bent(t, r, 0.02),
    "bent 1 cm": lambda t, r: bent(t, r, 0.01),
    "moving 5 m/s": lambda t, r: moving(t, r, 5.0),
    "moving 20 m/s": lambda t, r: moving(t, r, 20.0),
    "another frame": elsewhere,
    "cut 10 %": lambda t, r: cut(t, r, 0.1),
    "cut 20 %": lambda t, r: cut(t, r, 0.2),
    "noise x 5": lambda t, r: noisier(t, r, 5.0, 1.0),
    "ring bias x 5": lambda t, r: noisier(t, r, 1.0, 5.0),
    "stretched 5 %": lambda t, r: resized(t, r, 1.05, 1.0),
    "scaled +10 %": lambda t, r: resized(t, r, 1.1, 1.1),
    "scaled -10 %": lambda t, r: resized(t, r, 0.9, 0.9),
    "two rings": lambda t, r: few_rings(t, r, 2),
    "three rings": lambda t, r: few_rings(t, r, 3),
    "five rings": lambda t, r: few_rings(t, r, 5),
    "mirrored, no rings": mirrored,
    "dark squares 2 cm": lambda t, r: chequered(t, r, 0.02),
    "brightness x 3": lambda t, r: brighter(t, r, 3.0),
    "duplicates": duplicated,
    "10 % lost": lambda t, r: lost(t, r, 0.1),
    "30 % lost": lambda t, r: lost(t, r, 0.3),
    "1 stray": lambda t, r: strays(t, r, 1),
    "3 strays": lambda t, r: strays(t, r, 3),
    "bad day": bad_day,
}  # fmt: skip

CLEAN: dict[str, Callable[[Trial, np.random.Generator], Trial]] = {
    "clean": lambda t, r: t,
    "clean, no rings": ringless,
}
