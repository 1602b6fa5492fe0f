"""Where to put a target next: the placement that would sharpen what is known worst."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.observability import Direction
from optshape_graph.calibration.rig.graph import RigSolution
from optshape_graph.calibration.rig.result import NextPlacement, RigCalibration
from optshape_graph.calibration.rig.sightings import Sighting
from optshape_graph.se3 import adjoint, inverse

DISTANCES = (0.75, 1.0, 1.4)
"""Distances that are tried, in shares of the placement's own, from the sensor that is known worst."""

TURNS_DEG = (-35.0, 0.0, 35.0)
"""Angles about the vertical and about the horizontal by which the target is tried turned from how it stood."""

MOST_SOURCES = 20
"""Placements about which others are tried."""


def suggest_placement(
    calibration: RigCalibration, solved: RigSolution, information: Mapping[int, Floats]
) -> NextPlacement | None:
    """Try placements about those that were taken, nearer, farther and turned, and return the one that helps most.

    A sensor is expected to see a placement if it saw the one that it was made of, and as well as it saw that.

    Args:
        calibration: as far as it is known.
        solved: its graph.
        information: (6, 6) of each sighting's own pose, by number: of the right perturbation of T_sensor_target.
    """
    ranked = sorted(calibration.pairs, key=lambda pair: -calibration.directions(*pair)[0].sigma_m)
    sightings = solved.graph.start.sightings
    groups: dict[str, list[int]] = {}
    for number in information:
        groups.setdefault(sightings[number].placement, []).append(number)
    for pair in ranked:
        shared = [group for group in groups.values() if set(pair) & {sightings[n].sensor for n in group}]
        both = [group for group in shared if set(pair) <= {sightings[n].sensor for n in group}] or shared
        sources = [group for group in both if len({sightings[n].sensor for n in group}) > 1]
        if sources:
            step = max(1, len(sources) // MOST_SOURCES)
            return _best(calibration, pair, sightings, sources[::step], information)
    return None


def _best(
    calibration: RigCalibration,
    pair: tuple[str, str],
    sightings: Sequence[Sighting],
    sources: Sequence[Sequence[int]],
    information: Mapping[int, Floats],
) -> NextPlacement | None:
    now = calibration.directions(*pair)[0]
    total, best = np.linalg.inv(_regular(calibration.covariance)), None
    for group in sources:
        seen = [sightings[n] for n in group]
        anchor = next((s for s in seen if s.sensor == pair[0]), seen[0])
        for T_sensor_target in _placements(anchor):
            T_base_sensor = calibration.sensors[calibration.names.index(anchor.sensor)].T_base_sensor
            measured = [(sightings[n].sensor, information[n]) for n in group]
            added = _added(calibration, measured, T_base_sensor @ T_sensor_target)
            after = _worst(calibration, np.asarray(np.linalg.inv(total + added)), pair)
            if best is None or after.sigma_m < best.expected_sigma_m:
                best = NextPlacement(
                    anchor.target.name, anchor.sensor, T_sensor_target, tuple(dict.fromkeys(s.sensor for s in seen)),
                    pair, now.text, now.sigma_m, after.sigma_m,
                )  # fmt: skip
    return best


def _placements(anchor: Sighting) -> Iterator[Floats]:
    """Yield T_sensor_target of placements about one that a sensor saw."""
    T = anchor.pose
    ray = T[:3, 3]
    for share, yaw, pitch in product(DISTANCES, TURNS_DEG, TURNS_DEG):
        placed = np.array(T)
        placed[:3, 3] = share * ray
        turned = T[:3, :3] @ Rotation.from_euler("ZY", [yaw, pitch], degrees=True).as_matrix()
        if turned[:, 0] @ ray > 0.5 * np.linalg.norm(ray):  # it faces the sensor
            placed[:3, :3] = turned
            yield placed


def _added(calibration: RigCalibration, seen: Sequence[tuple[str, Floats]], T_base_target: Floats) -> Floats:
    """Information on the sensors' poses that sightings of one placement add, its own pose unknown."""
    n = len(calibration.covariance)
    whole, cross, own = np.zeros((n, n)), np.zeros((n, 6)), 1e-9 * np.eye(6)
    for name, information in seen:
        number = calibration.names.index(name)
        # T_sensor_target = E^-1 L: by L's perturbation 1, by E's -Ad(T_target_base E)
        by_sensor = -adjoint(inverse(T_base_target) @ calibration.sensors[number].T_base_sensor)
        own = own + information
        if number:
            rows = slice(6 * number - 6, 6 * number)
            whole[rows, rows] += by_sensor.T @ information @ by_sensor
            cross[rows] += by_sensor.T @ information
    return np.asarray(whole - cross @ np.linalg.solve(own, cross.T))


def _worst(calibration: RigCalibration, covariance: Floats, pair: tuple[str, str]) -> Direction:

    return replace(calibration, covariance=covariance).directions(*pair)[0]


def _regular(covariance: Floats) -> Floats:
    return covariance + 1e-12 * np.eye(len(covariance))
