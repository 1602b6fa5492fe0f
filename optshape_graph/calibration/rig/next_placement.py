"""Where to put a target next: the placement that would sharpen what is known worst."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.rig.result import NextPlacement, RigCalibration
from optshape_graph.calibration.rig.sightings import Sighting
from optshape_graph.calibration.rig.solution import RigSolution
from optshape_graph.se3 import adjoint, inverse

DISTANCES = (0.75, 1.0, 1.4)
"""Distances that are tried, in shares of the placement's own, from the sensor that is known worst."""

TURNS_DEG = (-35.0, 0.0, 35.0)
"""Angles about the vertical and about the horizontal by which the target is tried turned from how it stood."""

MOST_SOURCES = 20
"""Placements about which others are tried."""


def suggest_placement(calibration: RigCalibration, solved: RigSolution) -> NextPlacement | None:
    """Try placements about those that were taken, nearer, farther and turned, and return the one that helps most.

    A sensor is expected to see a placement if it saw the one that it was made of, and as well as it saw that, with
    standard deviations in proportion to the distance; errors that its sightings share, as those of a LiDAR's rings, are
    those of the new one, too.

    Args:
        calibration: as far as it is known.
        solved: its graph.
    """
    ranked = sorted(calibration.pairs, key=lambda pair: -calibration.directions(*pair)[0].sigma_m)
    sightings = solved.graph.start.sightings
    groups: dict[str, list[int]] = {}
    for number in solved.linked:
        groups.setdefault(sightings[number].placement, []).append(number)
    for pair in ranked:
        shared = [group for group in groups.values() if set(pair) & {sightings[n].sensor for n in group}]
        both = [group for group in shared if set(pair) <= {sightings[n].sensor for n in group}] or shared
        sources = [group for group in both if len({sightings[n].sensor for n in group}) > 1]
        if sources:
            step = max(1, len(sources) // MOST_SOURCES)
            return _best(calibration, pair, solved, sources[::step])
    return None


def _best(
    calibration: RigCalibration, pair: tuple[str, str], solved: RigSolution, sources: Sequence[Sequence[int]]
) -> NextPlacement | None:
    now, best = calibration.directions(*pair)[0], None
    sightings, known = solved.graph.start.sightings, _Known.of(calibration, solved)
    for group in sources:
        seen = [sightings[n] for n in group]
        anchor = next((s for s in seen if s.sensor == pair[0]), seen[0])
        for T_sensor_target in _placements(anchor):
            T_base_target = solved.T_base_sensor(anchor.sensor) @ T_sensor_target
            after = replace(calibration, covariance=known.with_placement(solved, group, T_base_target))
            sigma = after.directions(*pair)[0].sigma_m
            if best is None or sigma < best.expected_sigma_m:
                best = NextPlacement(
                    anchor.target.name, anchor.sensor, T_sensor_target, tuple(dict.fromkeys(s.sensor for s in seen)),
                    pair, now.text, now.sigma_m, sigma,
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


@dataclass(frozen=True, eq=False, repr=False)
class _Known(Value):
    """What is known of all that sightings share but the places of targets and platform.

    Attributes:
        covariance: (n, n) of it: the sensors' poses but the base's first, in their order, (m, m).
        columns: of each variable, by key.
        m: 6 times the number of sensors but the base.
        widening: by what the stated covariance is larger.
    """

    covariance: Floats
    columns: Mapping[int, slice]
    m: int
    widening: float

    @classmethod
    def of(cls, calibration: RigCalibration, solved: RigSolution) -> _Known:
        graph, system = solved.graph, solved.solution.system
        sensors = [graph.sensors[name] for name in calibration.names[1:]]
        alone = {*graph.placements.values(), *graph.moments.values(), *sensors}
        shared = sorted({key for link in solved.linked.values() for key in link.keys} - alone)
        columns, n = dict[int, slice](), 0
        for key in (*sensors, *shared):
            size = system.columns[key].stop - system.columns[key].start
            columns[key], n = slice(n, n + size), n + size
        covariance = system.covariance([*sensors, *shared])
        m = 6 * len(sensors)
        return cls(covariance, columns, m, float(np.trace(calibration.covariance) / np.trace(covariance[:m, :m])))

    def with_placement(self, solved: RigSolution, group: Sequence[int], T_base_target: Floats) -> Floats:
        """Return the stated covariance (m, m) of the sensors' poses with one placement more, its own pose unknown.

        Args:
            solved: the rig.
            group: numbers of the sightings that tell how well sensors see it.
            T_base_target: (4, 4) the placement.
        """
        rows, by_target = [], []
        for number in group:
            sighting, link = solved.graph.start.sightings[number], solved.linked[number]
            T_target_sensor = inverse(T_base_target) @ solved.T_base_sensor(sighting.sensor)
            nearer = np.linalg.norm(sighting.pose[:3, 3]) / np.linalg.norm(inverse(T_target_sensor)[:3, 3])
            R = nearer * link.by_pose
            if sighting.relative:  # (T Exp(x))^-1 = T^-1 Exp(-Ad(T) x)
                R = -R @ adjoint(sighting.pose)
            own = np.zeros((6, len(self.covariance)))
            for key, block in zip(link.keys, link.blocks, strict=True):
                if key in self.columns and key not in solved.graph.sensors.values():
                    own[:, self.columns[key]] += nearer * block
            if sighting.sensor in solved.graph.sensors:
                # T_sensor_target = E^-1 L: by L's perturbation 1, by E's -Ad(T_target_base E)
                own[:, self.columns[solved.graph.sensors[sighting.sensor]]] = -R @ adjoint(T_target_sensor)
            rows.append(own)
            by_target.append(R)
        J, A = np.vstack(by_target), np.vstack(rows)
        A = np.linalg.qr(J, mode="complete")[0][:, 6:].T @ A  # what no pose of the target takes up
        C = self.covariance @ A.T
        gain = C[: self.m] @ np.linalg.solve(np.eye(len(A)) + A @ C, C[: self.m].T)
        return np.asarray(self.widening * (self.covariance[: self.m, : self.m] - gain))
