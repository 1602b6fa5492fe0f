"""A start for the calibration graph, from nothing: where the sensors are, and how to read each sighting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.graph import Rig, Sighting
from optshape_graph.calibration.camera.sightings import Candidate, TargetInScan, View, candidates
from optshape_graph.calibration.consensus import CUT, Consensus, distances, relative_pose
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.errors import EstimationError, UnobservableError
from optshape_graph.se3 import inverse

AMBIGUOUS = 4.0
"""Truncated cost by which the best relative pose has to beat every different one; a view adds at most 9."""


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
    T_base_sensor = _connected(base, readings, list(placements.values()))

    sightings: list[Sighting] = []
    T_target_base: dict[int, Floats] = {}
    strangers: set[int] = set()
    for number, group in enumerate(placements.values()):
        T_base_target, read = _read(group, T_base_sensor)
        T_target_base[number] = inverse(T_base_target)
        for reading, c, agrees in read:
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


def _connected(base: str, readings: Sequence[_Reading], placements: Sequence[list[_Reading]]) -> dict[str, Floats]:
    """Add sensors one by one, each by the pair of sensors on which most placements agree."""
    T_base_sensor = {base: np.eye(4)}
    missing = list(dict.fromkeys(r.sensor for r in readings if r.sensor != base))
    while missing:
        links = [
            (known, new, found)
            for known in T_base_sensor
            for new in missing
            if (found := _pair(known, new, placements)) is not None
        ]
        if not links:
            names = ", ".join(f"'{name}'" for name in missing)
            raise UnobservableError(
                f"{names} saw no target that '{base}' or a sensor connected with it saw at the same time",
                tuple(f"pose of '{name}'" for name in missing),
            )
        known, new, found = max(links, key=lambda link: int(link[2].inlier.sum()))
        _check(known, new, found)
        T_base_sensor[new] = T_base_sensor[known] @ found.T_a_b
        missing.remove(new)
    return T_base_sensor


def _pair(a: str, b: str, placements: Sequence[list[_Reading]]) -> Consensus | None:
    shared = [
        (next((r for r in group if r.sensor == a), None), next((r for r in group if r.sensor == b), None))
        for group in placements
    ]
    both = [(r.poses, s.poses) for r, s in shared if r is not None and s is not None]
    return relative_pose([r for r, _ in both], [s for _, s in both]) if both else None


def _check(a: str, b: str, found: Consensus) -> None:
    agree, all_ = int(found.inlier.sum()), len(found.inlier)
    if 2 * agree <= all_ and all_ > 1:
        raise EstimationError(
            f"'{a}' and '{b}': only {agree} of the {_views(all_)} that both took part in agree on where the sensors are"
        )
    if found.runner_up - found.cost < AMBIGUOUS:
        raise UnobservableError(
            f"'{a}' and '{b}': a second relative pose fits the {_views(all_)} as well "
            f"(costs {found.cost:.1f} and {found.runner_up:.1f}); add views with the target at other angles",
            (f"which of the symmetric poses of the target '{b}' saw",),
        )


def _views(count: int) -> str:
    return "1 view" if count == 1 else f"{count} views"


def _read(
    group: Sequence[_Reading], T_base_sensor: dict[str, Floats]
) -> tuple[Floats, list[tuple[_Reading, Candidate, bool]]]:
    """Choose the target's pose in a placement, and each sighting's candidate; say which sightings agree."""
    # A scan is the reference where there is one, as it is read: its other labellings are the same placement.
    reference = next((r for r in group if isinstance(r.seen, TargetInScan)), group[0])
    options = reference.candidates[:1] if isinstance(reference.seen, TargetInScan) else reference.candidates
    readings = []
    for candidate in options:
        T_base_target = T_base_sensor[reference.sensor] @ candidate.T_sensor_target
        chosen, cost = [], 0.0
        for reading in group:
            among = reading.candidates if reading is not reference else (candidate,)
            moved = T_base_sensor[reading.sensor] @ np.stack([c.T_sensor_target for c in among])
            squared, _, j, _ = distances(np.eye(4), T_base_target[None, None], moved[None])
            chosen.append((reading, among[j[0]], bool(squared[0] < CUT**2)))
            cost += min(float(squared[0]), CUT**2)
        readings.append((cost, T_base_target, chosen))
    _, T_base_target, chosen = min(readings, key=lambda reading: reading[0])
    return T_base_target, chosen
