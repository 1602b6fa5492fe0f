"""Scenes, and the scans that a LiDAR takes of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats, Ints, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.scan import Scan
from optshape_graph.se3 import PoseLike, as_transform, inverse
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation.motion import Motion
from optshape_graph.simulation.noise import IDEAL, NoiseModel
from optshape_graph.simulation.odd_ends import make_odd_ends
from optshape_graph.simulation.rays import AngleErrors, EdgeMargin, Revolution, unit_vectors
from optshape_graph.simulation.surfaces import Patch, Surface
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class Scene(Value):
    """Targets, and all other surfaces that return light.

    Attributes:
        targets: the targets.
        background: floor, walls, stands, occluders, meshes.
    """

    targets: tuple[Patch, ...] = ()
    background: tuple[Surface, ...] = ()

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """All surfaces: the targets first, then the background."""
        return (*self.targets, *self.background)


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedScan(Value):
    """A scan with its truth.

    Attributes:
        scan: the returns.
        surface: (N,) index in `scene.surfaces` of the surface of each return.
        scene: the scene.
        T_world_lidar: (4, 4) the sensor's pose at the scan's stamp (time 0).
    """

    scan: Scan
    surface: Ints
    scene: Scene
    T_world_lidar: Floats

    @cached_property
    def T_lidar_targets(self) -> tuple[Floats, ...]:
        """(4, 4) true pose of each target in the LiDAR frame at the scan's stamp."""
        T_lidar_world = inverse(self.T_world_lidar)
        return tuple(frozen(T_lidar_world @ patch.T_world_patch) for patch in self.scene.targets)

    def target_returns(self, k: int = 0) -> Scan:
        """Return the returns of target k."""
        return self.scan.select(self.surface == k)

    def without_rings(self, rings: ArrayLike) -> SimulatedScan:
        """Return it without the returns of some rings, numbers (K,): partial illumination.

        Raises:
            InputError: the scan has no rings.
        """
        keep = ~np.isin(_rings(self.scan), rings)
        return replace(self, scan=self.scan.select(keep), surface=frozen(self.surface[keep], np.int64))


def simulate(
    scene: Scene,
    sensor: SensorModel,
    T_world_lidar: PoseLike | Motion | None = None,
    *,
    noise: NoiseModel = IDEAL,
    rng: np.random.Generator | int = 0,
    range_bias: Floats | None = None,
    angle_errors: AngleErrors | None = None,
    spin_rate: float = 10.0,
    name: str = "simulated",
) -> SimulatedScan:
    """Return one revolution.

    Args:
        scene: the surfaces; the nearest one on a ray returns.
        sensor: the sensor; its azimuth step and range limits apply.
        T_world_lidar: (4, 4) pose of a sensor at rest (None: the world's origin), or the motion of a moving one, for
            which each ray is fired from the pose at its own time, and its point is in the LiDAR frame of that time.
        noise: errors of measurements; none by default.
        rng: generator or seed.
        range_bias: (R,) range bias of each ring beside the one that the sensor's file has, metres; None: drawn from
            the noise.
        angle_errors: errors of the rings' directions, relative to the sensor's file; None: drawn from the noise.
        spin_rate: revolutions per second; sets the times.
        name: the scan's name.

    Raises:
        InputError: the sensor has no azimuth step, or range biases of another number of rings.
    """
    rng = np.random.default_rng(rng)
    errors = noise.draw_angle_errors(sensor.n_rings, rng) if angle_errors is None else angle_errors
    rays = Revolution.of(sensor, noise.draw_phase(sensor.azimuth_step or 0.0, rng), spin_rate, errors)
    bias = noise.draw_range_bias(sensor.n_rings, rng) if range_bias is None else frozen(range_bias)
    if bias.shape != (sensor.n_rings,):
        raise InputError(f"sensor '{sensor.name}' has {sensor.n_rings} rings; found range biases of shape {bias.shape}")
    bias = bias + sensor.deviations[0]
    placement: Any = np.eye(4) if T_world_lidar is None else T_world_lidar
    if not hasattr(placement, "at"):  # no motion
        placement = as_transform(placement, "T_world_lidar")
    if isinstance(placement, np.ndarray):
        rays = _facing(rays, scene, placement, noise.widest_edge_margin(sensor))
    origins, directions = _place(rays, placement)

    margin = replace(noise.draw_edge_margin(sensor, len(rays), rng), axis=_pose_at_stamp(placement)[:3, 2])
    ranges, surface, cos_incidence = _cast(scene, origins, directions, margin)
    if noise.odd_ends > 0:
        for k, patch in enumerate(scene.targets):
            make_odd_ends(k, patch, origins, directions, sensor.n_rings, ranges, surface, noise.odd_ends, rng)
    hit = np.flatnonzero((surface >= 0) & (ranges >= sensor.min_range) & (ranges <= sensor.max_range))
    hit = hit[noise.draw_survivors(cos_incidence[hit], rng)]
    ring = rays.ring(hit)
    bias = bias[ring] + noise.draw_brightness_bias(len(scene.surfaces), rng)[surface[hit]]
    r, azimuth, elevation = noise.measure(ranges[hit], rays.azimuth(hit), rays.elevation(hit), bias, rng)
    reflectivity = np.array([thing.reflectivity for thing in scene.surfaces])
    scan = Scan(
        points=r[:, None] * unit_vectors(azimuth, elevation),
        ring=ring,
        intensity=100.0 * reflectivity[surface[hit]] * cos_incidence[hit],
        time=rays.time(hit),
        sensor=sensor,
        name=name,
    )
    return SimulatedScan(scan, frozen(surface[hit], np.int64), scene, frozen(_pose_at_stamp(placement)))


def simulate_target(
    target: Target,
    sensor: SensorModel,
    T_lidar_target: PoseLike,
    *,
    noise: NoiseModel = IDEAL,
    rng: np.random.Generator | int = 0,
    range_bias: Floats | None = None,
    angle_errors: AngleErrors | None = None,
    name: str = "simulated",
) -> Scan:
    """Return one revolution's returns on one target, and nothing else: see `simulate`.

    Args:
        target: the target.
        sensor: the sensor, at rest.
        T_lidar_target: (4, 4) the target's pose.
        noise: errors of measurements; none by default.
        rng: generator or seed.
        range_bias: (R,) range bias of each ring beside the one that the sensor's file has, metres; None: drawn from
            the noise.
        angle_errors: errors of the rings' directions, relative to the sensor's file; None: drawn from the noise.
        name: the scan's name.
    """
    scene = Scene((Patch(target, as_transform(T_lidar_target, "T_lidar_target")),))
    made = simulate(scene, sensor, noise=noise, rng=rng, range_bias=range_bias, angle_errors=angle_errors, name=name)
    return made.scan


def random_rings(scan: Scan, share: float, rng: np.random.Generator | int = 0) -> Ints:
    """Return randomly drawn rings (K,) of a scan, to be left out for partial illumination.

    Args:
        scan: a scan with rings.
        share: of the rings with returns; rounded to whole rings.
        rng: generator or seed.

    Raises:
        InputError: the scan has no rings, or a share outside [0, 1].
    """
    if not 0 <= share <= 1:
        raise InputError(f"share of rings {share} is not within [0, 1]")
    present = np.unique(_rings(scan))
    return np.sort(np.random.default_rng(rng).choice(present, round(share * len(present)), replace=False))


def without_rings(scan: Scan, rings: ArrayLike) -> Scan:
    """Return the scan without the returns of some rings, numbers (K,): partial illumination.

    Raises:
        InputError: the scan has no rings.
    """
    return scan.select(~np.isin(_rings(scan), rings))


def _rings(scan: Scan) -> Ints:
    if scan.ring is None:
        raise InputError(f"{scan.name}: has no rings to leave out")
    return scan.ring


def _facing(rays: Revolution, scene: Scene, T_world_lidar: Floats, margin: EdgeMargin) -> Revolution:
    """Return the columns of a sensor at rest in which a ray may meet a surface."""
    bounds = [surface.bounds for surface in scene.surfaces]
    spheres = []
    for sphere in bounds:
        if sphere is None:
            return rays
        centre = (sphere[0] - T_world_lidar[:3, 3]) @ T_world_lidar[:3, :3]
        reach = margin.widen(sphere, np.array([np.linalg.norm(centre)]))
        spheres.append((centre, float(reach[0])))
    return rays.facing(spheres)


def _place(rays: Revolution, T_world_lidar: Floats | Motion) -> tuple[Floats, Floats]:
    """Return origins (1 or N, 3) and directions (N, 3) of rays in the world."""
    if isinstance(T_world_lidar, np.ndarray):
        return T_world_lidar[None, :3, 3], (T_world_lidar[:3, :3] @ rays.directions.T).T
    R, t = T_world_lidar.at(rays.time(np.arange(len(rays))))
    return t, np.einsum("nij,nj->ni", R, rays.directions)


def _pose_at_stamp(T_world_lidar: Floats | Motion) -> Floats:
    if isinstance(T_world_lidar, np.ndarray):
        return T_world_lidar
    T = np.eye(4)
    R, t = T_world_lidar.at(np.zeros(1))
    T[:3, :3], T[:3, 3] = R[0], t[0]
    return T


def _cast(scene: Scene, origins: Floats, directions: Floats, margin: EdgeMargin) -> tuple[Floats, Ints, Floats]:
    """Return the range (N,) to the nearest surface, its index (N,) (-1: none), and the cosine of incidence (N,)."""
    nearest = np.full(len(directions), np.inf)
    surface = np.full(len(directions), -1, dtype=np.int64)
    cosine = np.zeros(len(directions))
    for k, thing in enumerate(scene.surfaces):
        index, ranges, cos_incidence = thing.cast(origins, directions, margin)
        nearer = ranges < nearest[index]
        index = index[nearer]
        nearest[index], surface[index], cosine[index] = ranges[nearer], k, cos_incidence[nearer]
    return nearest, surface, cosine
