"""A solved rig: where its sensors are, what each sighting says of that, lenses, clocks, and errors of rings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gtsam.symbol_shorthand import D, K

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.rig.graph import CLOCK, RigGraph
from optshape_graph.calibration.rig.points import split, with_lens
from optshape_graph.calibration.rig.tracks import CLOCK_SIGMA
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.factors import SharedError
from optshape_graph.graph import Inverse, Solution


@dataclass(frozen=True, eq=False, repr=False)
class Linked(Value):
    """One sighting's rows ||R x + d||^2, by its variables.

    Attributes:
        keys: of the variables.
        blocks: (6, d_k) derivatives, whitened.
        d: (6,) whitened.
        by_pose: (6, 6) by the right perturbation of T_target_lidar, or of T_sensor_target of an image or of markers.
    """

    keys: list[int]
    blocks: list[Floats]
    d: Floats
    by_pose: Floats


@dataclass(frozen=True, eq=False, repr=False)
class RigSolution(Value):
    """A solved rig.

    Attributes:
        graph: what was solved.
        solution: of its variables.
        scans: numbers of the sightings by LiDARs that took part.
        others: of the others.
    """

    graph: RigGraph
    solution: Solution
    scans: tuple[int, ...]
    others: tuple[int, ...]

    @cached_property
    def chi2(self) -> dict[int, float]:
        """Of each sighting, by number, the chi-square that its own best pose would take away: 6 degrees of freedom."""
        models: Any = self.solution.models
        both = [*zip(self.scans, models[0].chi2, strict=True), *zip(self.others, models[1].chi2, strict=True)]
        return {n: float(value) for n, value in both}

    @cached_property
    def linked(self) -> dict[int, Linked]:
        """Of each sighting, by number, its rows that link poses and what it shares with others."""
        models: Any = self.solution.models
        scans, points, *_ = models
        found = {}
        for n, keys, by, R, by_errors, d, s in zip(
            self.scans, scans.term.chains.keys, scans.term.chains.derivatives(scans.R, scans.state),
            scans.R, scans.E, scans.d, scans.term.sensor, strict=True,
        ):  # fmt: skip
            own = by_errors[:, : len(scans.term.errors[s])]
            found[n] = Linked([*keys, scans.term.keys[s]], [*by, own], d, R)
        first = np.array([rows[:6, :6] for rows in points.rows]).reshape(-1, 6, 6)
        blocks = points.term.chains.derivatives(first, points.state)
        for n, keys, by, rows, shared in zip(
            self.others, points.term.chains.keys, blocks, points.rows, points.term.keys, strict=True
        ):
            columns = split(rows[:6, 6:-1], shared, points.state)
            found[n] = Linked([*keys, *shared], [*by, *columns], rows[:6, -1], rows[:6, :6])
        return found

    def pair(self, a: str, b: str) -> tuple[Floats, Floats]:
        """Return T_a_b (4, 4) of two sensors, and the covariance (6, 6) of its right perturbation, frame b.

        Raises:
            UnobservableError: it moves in a direction that is not observable.
        """
        sensors = self.graph.sensors
        return self.solution.relative([
            *([Inverse(sensors[a])] if a in sensors else []), *([sensors[b]] if b in sensors else []),
        ])  # fmt: skip

    def T_base_sensor(self, name: str) -> Floats:
        """Return where a sensor is (4, 4)."""
        key = self.graph.sensors.get(name)
        return np.eye(4) if key is None else self.solution.pose(key)

    def lens(self, camera: CameraIntrinsics) -> CameraIntrinsics:
        """Return a camera's intrinsics: as given, or, where the lens may be another, the likeliest."""
        if camera.name not in self.graph.free_lenses:
            return camera
        return with_lens(camera, self.solution.values.atVector(K(self.graph.camera_number(camera.name))))

    def clocks(self) -> tuple[dict[str, float], Floats]:
        """Return by how much more than taken each sensor's clock is ahead of the base's, and the covariance (n, n).

        Sensors that saw nothing move are left out; seconds, in the order of the names.
        """
        names, keys, places = list[str](), list[int](), list[int]()
        values, size = self.solution.values, 0
        models: Any = self.solution.models
        term = models[0].term
        for name in self.graph.start.T_base_sensor:
            key, place = D(self.graph.camera_number(name)), 0
            if name in self.graph.lidars:
                key = self.graph.lidars[name]
                errors = term.errors[term.keys.index(key)] if key in term.keys else ()
                if CLOCK not in errors:
                    continue
                place = errors.index(CLOCK)
            elif not values.exists(key):
                continue
            names.append(name)
            places.append(size + place)
            keys.append(key)
            size += len(values.atVector(key))
        if not names:
            return {}, np.zeros((0, 0))
        whole = np.concatenate([values.atVector(key) for key in keys])
        covariance = self.solution.system.covariance(keys)[np.ix_(places, places)]
        offsets = {name: float(CLOCK_SIGMA * whole[place]) for name, place in zip(names, places, strict=True)}
        return offsets, CLOCK_SIGMA**2 * covariance

    def ring_errors(self, lidar: str) -> dict[SharedError, tuple[float, float]]:
        """Return each error of a LiDAR's rings, and its standard deviation, in units of the prior's."""
        key = self.graph.lidars[lidar]
        models: Any = self.solution.models
        term = models[0].term
        errors = term.errors[term.keys.index(key)]
        sd = np.sqrt(np.diag(self.solution.covariance([key]))) if errors else np.zeros(0)
        values = self.solution.values.atVector(key)
        return {e: (float(x), float(s)) for e, x, s in zip(errors, values, sd, strict=True) if e != CLOCK}
