"""What simulated rigs see, without files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.scans import target_in_scan
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.calibration.rig import RigCalibration, calibrate
from optshape_graph.calibration.rig.reading import Read
from optshape_graph.calibration.rig.sightings import Sighting
from optshape_graph.errors import EstimationError
from optshape_graph.evaluation.rigs import CORNER_PX, Carried, SimulatedRig
from optshape_graph.io.sessions import About, Session
from optshape_graph.se3 import difference, inverse
from optshape_graph.target import Target

FEWEST_RETURNS = 20


def in_image(rig: SimulatedRig, camera: str, target: Target, T: Floats, rng: np.random.Generator):
    found = rig.corners(camera, target, T, rng)
    if found is None:
        return None
    points, pixels = found
    image = ImagePoints(points, pixels, np.tile(np.eye(2) / CORNER_PX, (len(points), 1, 1)))
    return TargetInImage(rig.cameras[camera], "image", image, planar_poses(image, rig.cameras[camera]))


def seen(
    rig: SimulatedRig,
    targets: Mapping[str, Target],
    placed: Sequence[Sequence[Floats]],
    rng: np.random.Generator,
    blind: Sequence[tuple[str, str]] = (),
) -> list[Sighting]:
    """Everything that a rig sees of targets in placements, but for pairs of sensor and target that are `blind`."""
    sightings = []
    for k, poses in enumerate(placed):
        for (name, plain), T in zip(targets.items(), poses, strict=True):
            target = replace(plain, name=name)
            for sensor in (*rig.lidars, *rig.cameras):
                if (sensor, name) in blind:
                    continue
                found = one(rig, sensor, target, T, rng, f"{k}_{sensor}_{name}")
                if found is not None:
                    sightings.append(
                        Sighting(sensor, target, k, f"{name}@{k}", found, f"{k}_{sensor}_{name}", float(k))
                    )
    return sightings


def one(rig: SimulatedRig, sensor: str, target: Target, T: Floats, rng: np.random.Generator, name: str):
    if sensor in rig.cameras:
        return in_image(rig, sensor, target, T, rng)
    scan = rig.scan(sensor, target, T, rng, name)
    try:
        return target_in_scan(scan, target, sensor) if len(scan) > FEWEST_RETURNS else None
    except EstimationError:
        return None


def among(
    rig: SimulatedRig,
    targets: Mapping[str, Target],
    standing: Mapping[str, Floats],
    poses: Sequence[Floats],
    rng: np.random.Generator,
    sees: Mapping[str, float],
) -> list[Sighting]:
    """What LiDARs see of targets that stand still (T_world_target) from a platform that moves (T_world_base).

    Args:
        sees: of each LiDAR 1 or -1: whether it is given what is ahead of the platform, or what is behind it.
    """
    sightings = []
    for k, X in enumerate(poses):
        for name, plain in targets.items():
            target, T = replace(plain, name=name), inverse(X) @ standing[name]
            for lidar, side in sees.items():
                if side * T[0, 3] > 0 and (found := one(rig, lidar, target, T, rng, f"{k}_{lidar}_{name}")) is not None:
                    sightings.append(Sighting(lidar, target, k, name, found, f"{k}_{lidar}_{name}", float(k)))
    return sightings


def moving(
    rig: SimulatedRig, target: Target, path: Carried, count: int, offsets: Mapping[str, float], rng: np.random.Generator
) -> list[Sighting]:
    """`count` sightings by each sensor, ten a second, of a target that is carried; clocks are ahead by `offsets`, s."""
    sightings = []
    for sensor in (*rig.lidars, *rig.cameras):
        phase = rng.uniform(0.0, 0.1)
        for k in range(count):
            time, name = phase + 0.1 * k, f"{sensor}_{k}"
            if sensor in rig.cameras:
                found, at = in_image(rig, sensor, target, path.at(np.array([time]))[0], rng), 0.0
            else:
                scan = rig.moving_scan(sensor, target, path, time, rng, name)
                try:
                    found = target_in_scan(scan, target, sensor) if len(scan) > FEWEST_RETURNS else None
                except EstimationError:
                    found = None
                at = 0.0 if found is None else float(scan.time.mean())
            if found is not None:
                n = len(sightings)
                stamp = time + at + offsets.get(sensor, 0.0)
                sightings.append(Sighting(sensor, target, n, f"{target.name}~{n}", found, name, stamp, moving=True))
    return sightings


def calibrated(
    rig: SimulatedRig, sightings: Sequence[Sighting], platform_moves: bool = False, initial: tuple[About, ...] = ()
) -> RigCalibration:
    """The calibration of what a rig saw."""
    session = Session(
        "rig", Path("session.yaml"), rig.lidars, rig.cameras, {}, (), None, frozenset(), platform_moves, initial
    )
    return calibrate(Read(tuple(sightings), (), (*rig.lidars, *rig.cameras)), session)


def errors(rig: SimulatedRig, result: RigCalibration) -> dict[str, Floats]:
    """By kind of pair ("LL", "LC", "CC") rows of translation, mm, rotation, deg, and squared error per freedom."""
    found: dict[str, list[tuple[float, float, float]]] = {}
    for a, b in combinations(result.names, 2):
        T, covariance = result.transform(a, b)
        x = difference(rig.pair(a, b), T)
        kind = "".join(sorted("L" if name in rig.lidars else "C" for name in (a, b)))[::-1]
        row = (1e3 * np.linalg.norm(x[3:]), np.degrees(np.linalg.norm(x[:3])), x @ np.linalg.solve(covariance, x) / 6)
        found.setdefault(kind, []).append(row)
    return {kind: np.array(rows) for kind, rows in found.items()}
