"""Scans of known truth, in groups: legal scans of real beams, and scans of the independent ray caster."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph.io import load_sensor, load_target
from optshape_graph.scan import Scan
from optshape_graph.simulation import NoiseModel, pose_from_rpy, simulate_target
from optshape_graph.target import Target
from tests.casting.caster import Receiver, Wall, cast

HEXAGON = Target.from_polygon(
    [(0.62, -0.18), (0.55, 0.35), (0.05, 0.62), (-0.42, 0.40), (-0.58, -0.05), (-0.12, -0.55)], "hexagon"
).scaled_to_area(1.0)
"""An irregular hexagon of 1 m2."""


@dataclass(frozen=True)
class Group:
    """Scans that are alike.

    Attributes:
        targets: names of built-in targets, or "hexagon"; `name@area` scales. Taken in turn.
        sensors: names of built-in sensors, taken in turn.
        ranges: metres, from and to.
        incidence_deg: angle between the target's normal and the line of sight, from and to; None: roll, pitch and yaw
            each within 35 deg.
        cast: by the independent ray caster, with any roll; else by the simulator.
    """

    targets: tuple[str, ...]
    sensors: tuple[str, ...]
    ranges: tuple[float, float]
    incidence_deg: tuple[float, float] | None = None
    cast: bool = False


GROUPS = {
    "vlp16 1 m2": Group(("paper", "optimal"), ("vlp16",), (8, 25)),
    "vlp16 0.5 m2": Group(("paper@0.5", "optimal@0.5"), ("vlp16",), (6, 12)),
    "os0-64": Group(("paper", "optimal"), ("os0-64",), (10, 25)),
    "os1-64": Group(("paper", "optimal"), ("os1-64",), (15, 30)),
    "vlp32c built": Group(("built",), ("vlp32c",), (20, 40)),
    "vlp32c optimal": Group(("optimal",), ("vlp32c",), (15, 35)),
    "grazing": Group(("paper", "optimal"), ("vlp16", "vlp32c", "os1-64", "os0-64"), (3, 10), (55, 80)),
    "cast paper": Group(("paper",), ("vlp16", "os1-64"), (3, 25), cast=True),
    "cast square": Group(("square",), ("vlp16", "os1-64"), (3, 25), cast=True),
    "cast triangle": Group(("triangle",), ("vlp16", "os1-64"), (3, 25), cast=True),
    "cast hexagon": Group(("hexagon",), ("vlp16", "os1-64"), (3, 25), cast=True),
}


def load_shape(name: str) -> Target:
    """Return a built-in target, `name@area`, or the hexagon."""
    shape, _, area = name.partition("@")
    target = HEXAGON if shape == "hexagon" else load_target(shape)
    return target.scaled_to_area(float(area)) if area else target


def draw(name: str, seed: int, index: int) -> tuple[Scan, Target, np.ndarray]:
    """Return the scan of that index in a group, with its target and its true T_lidar_target (4, 4).

    Poses that return fewer than three times or in fewer than two rings are drawn anew.
    """
    group = GROUPS[name]
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(sorted(GROUPS).index(name), index)))
    target = load_shape(group.targets[index % len(group.targets)])
    sensor = load_sensor(group.sensors[index // len(group.targets) % len(group.sensors)])
    while True:
        T = _place(group, rng)
        if group.cast:
            wall = Wall(rng.uniform(1.0, 10.0), rng.uniform(0.1, 0.8)) if index % 2 else None
            receiver = Receiver(
                threshold=rng.uniform(0.2, 0.8),
                first=index % 3 == 0,
                azimuth_jitter=np.radians(0.02),
                range_noise=0.01 * rng.uniform(0.5, 2.0),
                ring_bias=0.01,
                brightness=sensor.brightness_bias * rng.normal(),
                glow=rng.uniform(0.0, 0.1),
            )
            full, own = cast(target, sensor, T, receiver, rng, wall)
            scan = full.select(own)
        else:
            scan = simulate_target(target, sensor, T, noise=NoiseModel.of(sensor), rng=rng)
        if len(scan) >= 3 and scan.ring is not None and len(np.unique(scan.ring)) >= 2:
            return scan, target, T


def _place(group: Group, rng: np.random.Generator) -> np.ndarray:
    """A pose in front of the sensor, anywhere around it, within a few degrees of the horizon."""
    distance, bearing, height = rng.uniform(*group.ranges), rng.uniform(-np.pi, np.pi), rng.uniform(-0.05, 0.05)
    if group.incidence_deg is None:
        roll, pitch, yaw = np.radians(rng.uniform(-35, 35, 3))
        roll = rng.uniform(-np.pi, np.pi) if group.cast else roll
        T = pose_from_rpy([0, 0, 0], [roll, pitch, yaw])
    else:
        T = np.eye(4)
        about = rng.uniform(0, 2 * np.pi)
        tilt = np.radians(rng.uniform(*group.incidence_deg)) * np.array([0.0, np.cos(about), np.sin(about)])
        spin = Rotation.from_rotvec([rng.uniform(-np.pi, np.pi), 0, 0])
        T[:3, :3] = (Rotation.from_rotvec(tilt) * spin).as_matrix()
    line_of_sight = Rotation.from_euler("ZY", [bearing, -height])
    T[:3, :3] = line_of_sight.as_matrix() @ T[:3, :3]
    T[:3, 3] = line_of_sight.apply([distance, 0, 0])
    return T
