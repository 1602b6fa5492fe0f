"""A start for the calibration graph, from nothing: where the sensors are, and how to read each sighting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.graph import Rig, Sighting
from optshape_graph.calibration.camera.sightings import Candidate, TargetInScan, View, candidates
from optshape_graph.calibration.connection import connected, read
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.errors import EstimationError, UnobservableError
from optshape_graph.se3 import inverse


@dataclass(frozen=True, eq=False, repr=False)
class Start(Value):
    """Where the graph starts.

    Attributes:
        sightings: all of them, read in the way that agrees best.
        rig: where the sensors and the targets are.
        agreeing: numbers of the views that agree with it.
    """

    sightings: tuple[Sighting, ...]
    rig: Rig
    agreeing: frozenset[int]


@dataclass(frozen=True, eq=False, repr=False)
class _Reading(Value):
    """A sighting with all its candidates."""

    views: tuple[int, ...]
    sensor: str
    seen: TargetInScan | TargetInImage
    candidates: tuple[Candidate, ...]

    @property
    def poses(self) -> Floats:
        return np.stack([candidate.T_sensor_target for candidate in self.candidates])

    @property
    def relative(self) -> bool:
        return isinstance(self.seen, TargetInScan)


def find_start(views: Sequence[View]) -> Start:
    """Connect all sensors by the placements that they share, and read every sighting in that light.

    Args:
        views: of one or several LiDARs and cameras; the first LiDAR's frame becomes the base.

    Raises:
        EstimationError: no LiDAR saw a target, or the views contradict each other.
        UnobservableError: a sensor shares no placement with the others, or two answers fit equally well.
    """
    placements = _readings(views)
    readings = [reading for group in placements.values() for reading in group]
    lidars = [reading.sensor for reading in readings if isinstance(reading.seen, TargetInScan)]
    if not lidars:
        problems = dict.fromkeys(view.problem for view in views if view.problem)
        raise EstimationError("; ".join(["no target was found in any scan", *problems]))
    base = lidars[0]
    T_base_sensor = connected(base, list(placements.values()))
    if missing := list(dict.fromkeys(r.sensor for r in readings if r.sensor not in T_base_sensor)):
        raise UnobservableError(
            f"{', '.join(repr(name) for name in missing)} saw no target that '{base}' or a sensor connected with it "
            "saw at the same time",
            tuple(f"pose of '{name}'" for name in missing),
        )

    sightings: list[Sighting] = []
    T_target_base: dict[int, Floats] = {}
    strangers: set[int] = set()
    for number, group in enumerate(placements.values()):
        T_base_target, chosen = read(group, T_base_sensor, as_it_is=True)
        T_target_base[number] = inverse(T_base_target)
        for reading, n, agrees in chosen:
            c = reading.candidates[n]
            if not agrees:
                strangers.update(reading.views)
            target = views[reading.views[0]].target.name
            place = (reading.views, reading.sensor, number, reading.seen, target)
            sightings.append(Sighting(*place, c.S, c.T_sensor_target, c.covariance))
    cameras = {r.sensor: r.seen.camera for r in readings if isinstance(r.seen, TargetInImage)}
    alone = {view for group in placements.values() if len(group) == 1 for view in group[0].views}
    agreeing = frozenset(view for s in sightings for view in s.views) - strangers - alone
    return Start(tuple(sightings), Rig(T_base_sensor, T_target_base, {}, cameras), agreeing)


def _readings(views: Sequence[View]) -> dict[str, list[_Reading]]:
    """Collect the sightings of each placement; one that several views share counts once."""
    placements: dict[str, dict[int, _Reading]] = {}
    for number, view in enumerate(views):
        group = placements.setdefault(view.placement, {})
        for seen in (view.scan, view.image):
            if seen is None:
                continue
            sensor = seen.lidar if isinstance(seen, TargetInScan) else seen.camera.name
            known = group.get(id(seen))
            numbers = (*known.views, number) if known else (number,)
            group[id(seen)] = _Reading(
                numbers, sensor, seen, known.candidates if known else candidates(seen, view.target)
            )
    return {name: list(group.values()) for name, group in placements.items()}
