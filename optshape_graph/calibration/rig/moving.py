"""Sensors connected by what moves in view of them, and their clocks: a start from nothing, and the solution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.scans import target_in_scan
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.consensus import rigid_fit
from optshape_graph.calibration.rig.graph import RigGraph
from optshape_graph.calibration.rig.sightings import Sighting
from optshape_graph.calibration.rig.solution import RigSolution
from optshape_graph.calibration.rig.solve import solve_graph
from optshape_graph.calibration.rig.tracks import LEAST_DENSITY, Track, estimate_density
from optshape_graph.errors import EstimationError, UnobservableError
from optshape_graph.mapping.motion import deskew
from optshape_graph.se3 import adjoint, difference, exp, inverse

LONGEST_GAP = 0.35
"""Time between two sightings of one sensor, seconds, across which the target's motion may be interpolated."""

FARTHEST_CLOCK, CLOCK_STEP = 1.0, 0.02
"""Offsets of two clocks that are tried, seconds."""

FEWEST = 8
"""Sightings that two sensors must have at common times."""

AGREES_M = 0.1
"""Median distance of two sensors' sightings, metres, up to which an offset may be right."""

WINDOW = 0.25
"""Time before and after a sighting, seconds, whose sightings tell its twist."""

MOST_ROUNDS, ROUNDS_OF_DENSITY, SAMPLED = 12, 6, 24
"""Times that tracks are made again; of these, those in which the density is estimated; and by how many pairs."""

FARTHEST_REACH = 4.0
"""How many of its own steps expectation maximisation goes at most, where it goes on the same way: alone it takes
dozens to find how smooth a motion is, and stated clocks a tenth too uncertain after four."""

AT_REST = 2e-5
"""Change of a clock, seconds, that ends the rounds."""


@dataclass(frozen=True, eq=False, repr=False)
class Clocks(Value):
    """What is known of sensors' clocks.

    Attributes:
        offsets: seconds by which each sensor's clock is ahead of the base's, by name.
        covariance: (n, n) of the offsets, square seconds, in the order of `names`.
        names: of the sensors whose clocks are told.
    """

    offsets: Mapping[str, float] = field(default_factory=dict)
    covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    names: tuple[str, ...] = ()


def connect(
    sightings: Sequence[Sighting], base: str, known: Mapping[str, Floats]
) -> tuple[dict[str, Floats], dict[str, float], list[Sighting]]:
    """Find sensors and clocks by a target that moves in view of two of them at a time.

    Args:
        sightings: of targets that move.
        base: whose frame and clock are the common ones.
        known: T_base_sensor (4, 4) of sensors, as far as what stands still told.

    Returns:
        T_base_sensor (4, 4) and the offset, seconds, of every sensor that can be reached; and the sightings, read in
        that light.

    Raises:
        UnobservableError: two sensors saw it at common times, but at no offset of their clocks alike.
    """
    tracks = {name: _read(sightings, name) for name in dict.fromkeys(s.sensor for s in sightings)}
    places, offsets = {base: np.eye(4), **known}, {base: 0.0}
    while missing := [name for name in tracks if name not in offsets]:
        found = [
            (fit, a, b) for a in offsets if a in tracks for b in missing
            if (fit := _aligned(tracks[a], tracks[b], offsets[a])) is not None
        ]  # fmt: skip
        if not found:
            break
        (_, error, offset, T_a_b, relabelled), a, b = max(found, key=lambda link: link[0][0])
        if error > AGREES_M:
            raise UnobservableError(
                f"'{a}' and '{b}' saw a target move, but at no offset of their clocks within {FARTHEST_CLOCK:g} s "
                f"alike ({1e3 * error:.0f} mm apart at best): are the stamps of one clock?",
                (f"clock of '{b}'",),
            )
        offsets[b], tracks[b] = offset, relabelled
        places.setdefault(b, places[a] @ T_a_b)
    read = [sighting for name in tracks for sighting in tracks[name]]
    return places, offsets, read


def _read(sightings: Sequence[Sighting], sensor: str) -> list[Sighting]:
    """One sensor's sightings by time, each read as the one before it."""
    read: list[Sighting] = []
    before: dict[str, Floats] = {}
    for sighting in sorted((s for s in sightings if s.sensor == sensor), key=_time):
        last = before.get(sighting.target.name)
        number = 0
        if last is not None:
            number = int(np.einsum("ij,kij->k", last[:3, :3], sighting.poses[:, :3, :3]).argmax())
        read.append(sighting.read_as(number))
        before[sighting.target.name] = sighting.poses[number]
    return read


def _time(sighting: Sighting) -> float:
    assert sighting.time is not None
    return sighting.time


def _aligned(
    a: Sequence[Sighting], b: Sequence[Sighting], offset_a: float
) -> tuple[int, float, float, Floats, list[Sighting]] | None:
    """The offset of b's clock and T_a_b with which b's sightings are most alike to a's; None: no common times.

    Returns:
        How many sightings they have at common times, the median distance between them, metres, the offset, the
        transform, and b's sightings, read as a's.
    """
    best: tuple[int, float, float, Floats, list[Sighting]] | None = None
    turns = b[0].candidates if b[0].relative else b[0].candidates[:1]
    for turn in turns:  # which of a symmetric target's vertices is the first, one turn of all tells
        T = np.array([s.pose @ inverse(turn.S) for s in b])
        for offset in np.arange(-FARTHEST_CLOCK, FARTHEST_CLOCK + 1e-9, CLOCK_STEP):
            A, rows = _interpolated(a, np.array([_time(s) for s in b]) - offset + offset_a, [s.target.name for s in b])
            if len(rows) < FEWEST:
                continue
            T_a_b = rigid_fit(A, T[rows], np.full(len(rows), 0.02), np.radians(1.0))
            apart = np.linalg.norm((T_a_b @ T[rows])[:, :3, 3] - A[:, :3, 3], axis=1)
            turned = np.linalg.norm(difference(A, T_a_b @ T[rows])[:, :3], axis=1)
            error = float(np.median(apart + turned))
            if best is None or error < best[1]:
                read = [s.relabelled(turn.S) for s in b]
                best = (len(rows), error, float(offset), T_a_b, read)
    return best


def _interpolated(track: Sequence[Sighting], times: Floats, targets: Sequence[str]) -> tuple[Floats, np.ndarray]:
    """Poses (m, 4, 4) of targets at some times, between two sightings of a track, and which (m,) times those are."""
    poses, rows = [], []
    own = {name: [s for s in track if s.target.name == name] for name in set(targets)}
    known = {name: np.array([_time(s) for s in group]) for name, group in own.items()}
    for row, (time, name) in enumerate(zip(times, targets, strict=True)):
        after = int(np.searchsorted(known[name], time))
        if 0 < after < len(known[name]) and known[name][after] - known[name][after - 1] < LONGEST_GAP:
            before, gap = own[name][after - 1].pose, known[name][after] - known[name][after - 1]
            step = difference(before, own[name][after].pose)
            poses.append(before @ exp(step * (time - known[name][after - 1]) / gap))
            rows.append(row)
    return np.array(poses).reshape(-1, 4, 4), np.array(rows, int)


def solve_moving(
    graph: RigGraph, moving: Sequence[Sighting], offsets: Mapping[str, float]
) -> tuple[RigSolution, Clocks]:
    """Solve for a rig with targets that move, tracks made again with the clocks found until those rest.

    Args:
        graph: of what stands still.
        moving: sightings of what moves, as they are read.
        offsets: of the clocks to begin with, seconds.

    Raises:
        EstimationError: the clocks do not come to rest.
    """
    start, offsets, moving, density = graph.start, dict(offsets), list(moving), graph.density
    poses = [start.T_base_sensor[s.sensor] @ s.pose for s in moving]
    values, before, reach = None, np.zeros(2), np.ones(2)
    for round_ in range(MOST_ROUNDS):
        times = np.array([_time(s) - offsets[s.sensor] for s in moving])
        twists = _twists(moving, times, poses)
        if round_ in (0, 1):
            moving, poses = _straightened(moving, poses, twists, start.T_base_sensor)
        first = len(start.sightings)
        placed = {**start.T_world_target, **{s.placement: T for s, T in zip(moving, poses, strict=True)}}
        state = replace(start, sightings=(*start.sightings, *moving), T_world_target=placed)
        tracks = []
        for name in dict.fromkeys(s.target.name for s in moving):
            order = sorted((k for k, s in enumerate(moving) if s.target.name == name), key=lambda k: times[k])
            own = np.array([twists[k] for k in order])
            tracks.append(Track(tuple(first + k for k in order), times[order], own))
        current = replace(graph, start=state, tracks=tuple(tracks), density=density)
        solved = solve_graph(current, None, values)
        change, covariance = solved.clocks()
        if not change:
            raise EstimationError("one sensor alone saw a target move: that tells no clock")
        offsets |= {name: offsets[name] + value for name, value in change.items()}
        solution = solved.solution
        poses = [solution.pose(current.placements[s.placement]) for s in moving]
        values = solution.values
        if round_ < ROUNDS_OF_DENSITY:
            step = np.log(_density(solved, density) / np.array(density))
            reach = np.where(step * before > 0, np.minimum(2 * reach, FARTHEST_REACH), 1.0)
            rotation, translation = np.maximum(density * np.exp(reach * step), LEAST_DENSITY)
            density, before = (float(rotation), float(translation)), step
        elif max(map(abs, change.values())) < AT_REST:
            return solved, Clocks(offsets, covariance, tuple(change))
    still_by = 1e3 * max(map(abs, change.values()))
    raise EstimationError(f"the clocks do not come to rest: they still move by {still_by:.2f} ms")


def _twists(moving: Sequence[Sighting], times: Floats, poses: Sequence[Floats]) -> list[Floats]:
    """Twists (6,) by the sightings about each: a line through what they differ by.

    A clock's offset is where what sightings are off by has nothing in common with twists. Those of the graph have: they
    follow each sighting's own error, always the same way where one sensor takes its turn soon after the other, which
    moved clocks by three standard deviations. A line through the others does not.
    """
    twists, names, T = [], np.array([s.target.name for s in moving]), np.array(poses)
    for k, time in enumerate(times):
        near = np.flatnonzero((np.abs(times - time) < WINDOW) & (names == names[k]) & (np.arange(len(times)) != k))
        h, xi = times[near] - time, difference(T[k], T[near])
        rows = np.column_stack([np.ones(len(h)), h])
        slope = np.linalg.lstsq(rows, xi, rcond=1e-6)[0][1] if len(near) > 2 else np.zeros(6)
        twists.append(np.asarray(slope))
    return twists


def _straightened(
    moving: Sequence[Sighting], poses: Sequence[Floats], twists: Sequence[Floats], T_base_sensor: Mapping[str, Floats]
) -> tuple[list[Sighting], list[Floats]]:
    """Measure the targets in scans again, each return brought from its own time to the mean of all.

    A scan that says nothing of its target then is left as it was.
    """
    again, placed = [], []
    for sighting, T_base_target, twist in zip(moving, poses, twists, strict=True):
        seen = sighting.seen
        if isinstance(seen, TargetInScan) and seen.own.time is not None:
            # H = T_target_lidar becomes Exp(-V t) H = H Exp(-Ad(H^-1) V t).
            of_lidar = -adjoint(inverse(T_base_sensor[sighting.sensor]) @ T_base_target) @ twist
            as_fired = sighting.fired or seen.own
            assert as_fired.time is not None
            straight = deskew(as_fired, of_lidar, float(as_fired.time.mean()))
            try:
                made = replace(
                    sighting, seen=target_in_scan(straight, sighting.target, sighting.sensor), fired=as_fired
                )
            except EstimationError:
                made = sighting
            number = int(np.einsum("ij,kij->k", sighting.pose[:3, :3], made.poses[:, :3, :3]).argmax())
            sighting = made.read_as(number)
        again.append(sighting)
        placed.append(T_base_target)
    return again, placed


def _density(solved: RigSolution, density: tuple[float, float]) -> Floats:
    """The density (2,) of acceleration, rotation first, after a step of expectation maximisation."""
    models: Any = solved.solution.models
    new = []
    for model in models[2:]:
        pairs = range(0, len(model.e), max(1, len(model.e) // SAMPLED))
        covariances = {m: solved.solution.system.covariance(model.keys(m)) for m in pairs}
        new.append(estimate_density(model, covariances, np.array(density)))
    return np.asarray(np.mean(new, axis=0))
