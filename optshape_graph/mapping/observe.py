"""What a keyframe's scan shows: the targets in it, each where it was when the LiDAR stood at the scan's stamp."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.detection import detect_targets
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.records import from_record, to_record
from optshape_graph.mapping.keyframes import HALF_REVOLUTION, Keyframe
from optshape_graph.mapping.motion import deskew, estimate_all_moving
from optshape_graph.mapping.shapes import shape_measurement
from optshape_graph.mapping.sweep import Sweep
from optshape_graph.mapping.track import Sighting
from optshape_graph.pose import PoseEstimate
from optshape_graph.runs.journal import Journal
from optshape_graph.runs.workers import Lost, Pool
from optshape_graph.scan import Scan
from optshape_graph.target import Target

SLOW = np.array([0.01] * 3 + [0.02] * 3)
"""Twist, rad/s and m/s, below which a scan counts as taken at rest: a millimetre in half a revolution."""

OFF_ITS_RING = 0.25
"""Share of the gap between rings by which deskewing may lift returns off their elevation: with less the estimate is the
same to a fraction of its standard deviation (0.15, root mean square); with more it takes one at the target's own time,
in whose frame rings are where they were fired."""


class Observed(NamedTuple):
    """What was seen at a keyframe.

    Attributes:
        stamp: seconds.
        T_odometry_lidar: (4, 4) at the stamp, of several LiDARs that of the first; None: no odometry.
        distance: gone since the keyframe before, metres.
        sightings: of targets.
        failure: why the scan could not be used, else empty.
    """

    stamp: float
    T_odometry_lidar: Floats | None
    distance: float
    sightings: tuple[Sighting, ...]
    failure: str


def observe(keyframe: Keyframe, targets: Sequence[Target], named: bool, shapes: bool, biases: bool = True) -> Observed:
    """Find the targets in a keyframe's scan, moved to the scan's stamp.

    A scan with times is deskewed: whatever the LiDAR did in between is a known motion. Outlines are straight then; but
    where the motion lifts returns off their rings, poses are estimated at each target's own time.

    Args:
        keyframe: the scan and its motion.
        targets: to look for.
        named: whether there is one of each template, so that the template is the landmark's name.
        shapes: whether to keep what refines the vertices.
        biases: whether to keep what tells the biases of the LiDAR's rings: a few kilobytes for each sighting.
    """
    scan, sweep = keyframe.scan, keyframe.sweep
    T_odometry_lidar = keyframe.T_odometry_first
    moving = sweep is not None and scan.time is not None and bool((np.abs(sweep.twist) > SLOW).any())
    straight = deskew(scan, sweep) if sweep is not None and moving else scan
    try:
        found = detect_targets(straight, targets).found
    except (EstimationError, InputError) as error:
        return Observed(keyframe.stamp, T_odometry_lidar, keyframe.distance, (), _reason(error))
    known = [one for one in found if one.rival is None or one.status != "ambiguous"]  # which target it is
    fired = [scan.select(one.indices) for one in known]
    sightings: dict[int, Sighting] = {}
    lifted: list[int] = []
    for k, detection in enumerate(known):
        returns = straight.select(detection.indices)
        if moving and (_lifted(fired[k], returns) > OFF_ITS_RING or not detection.estimate.usable):
            lifted.append(k)
        elif detection.estimate.usable:
            name = detection.target.name if named else None
            seen = _sighting(detection.estimate, returns, name, shapes, biases)
            sightings[k] = seen if sweep is None else seen.moved(np.eye(4), _uncertainty(fired[k], sweep))
    if sweep is not None:
        wanted = [known[k].target for k in lifted]
        for k, again in zip(lifted, estimate_all_moving([fired[k] for k in lifted], wanted, sweep), strict=True):
            if not isinstance(again, EstimationError) and again[0].usable:
                name = known[k].target.name if named else None
                sightings[k] = _moving_sighting(fired[k], *again, sweep, name, shapes, biases)
    first = keyframe.T_first_lidar
    placed = [
        replace(seen, lidar=keyframe.lidar) if first is None else seen.on_body(first, keyframe.lidar)
        for _, seen in sorted(sightings.items(), key=lambda item: item[0])
    ]
    return Observed(keyframe.stamp, T_odometry_lidar, keyframe.distance, tuple(placed), "")


def _uncertainty(fired: Scan, sweep: Sweep) -> Floats:
    """How well the motion from a scan's stamp to the time of some returns is known (6, 6), rotation first.

    Without times, that is any within half a revolution of the stamp.
    """
    if fired.time is None:
        return np.outer(sweep.twist, sweep.twist) * HALF_REVOLUTION**2 / 3.0
    return sweep.uncertainty(0.0, float(fired.time.mean()))


def _lifted(fired: Scan, straight: Scan) -> float:
    """Largest change of a return's elevation by deskewing, in the least gap between the rings on the target."""
    before, after = (np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (fired.points, straight.points))
    assert fired.ring is not None  # targets are found ring by ring
    _, ring = np.unique(fired.ring, return_inverse=True)
    of_ring = np.bincount(ring, before) / np.bincount(ring)
    return float(np.abs(after - before).max() / np.diff(of_ring).min())  # four rings at least: it was detected


def _sighting(estimate: PoseEstimate, returns: Scan, name: str | None, shapes: bool, biases: bool) -> Sighting:
    shape = shape_measurement(estimate, returns) if shapes and estimate.status == "ok" else None
    return Sighting.of(estimate, name, shape, biases=biases)


def _moving_sighting(
    returns: Scan, estimate: PoseEstimate, at: float, sweep: Sweep, name: str | None, shapes: bool, biases: bool
) -> Sighting:
    """A sighting from the scan's stamp, of returns taken while moving, whose target's pose is known at their time."""
    sighting = _sighting(estimate, deskew(returns, sweep, at), name, shapes, biases)
    return sighting.moved(sweep.between(0.0, at), sweep.uncertainty(0.0, at))


def observe_all(
    frames: Iterable[Keyframe],
    targets: Sequence[Target],
    named: bool,
    shapes: bool,
    pool: Pool | None = None,
    biases: bool = True,
    journal: Journal | None = None,
) -> Iterator[Observed]:
    """Observe keyframes, and yield them in their order; a few scans ahead of it, so that memory does not grow.

    Args:
        frames: the keyframes.
        targets: to look for.
        named: whether there is one of each template, so that the template is the landmark's name.
        shapes: whether to keep what refines the vertices.
        pool: what runs it; None: this process.
        biases: whether to keep what tells the biases of the LiDAR's rings.
        journal: of what was seen in a run that was stopped, and in this one; None: nothing is kept.

    Raises:
        InputError: the journal is of another recording.
    """
    work = partial(observe, targets=tuple(targets), named=named, shapes=shapes, biases=biases)
    given: dict[int, Keyframe] = {}  # those that are with a worker, or kept and not yielded yet

    def new() -> Iterator[tuple[int, Keyframe]]:
        for number, frame in enumerate(frames):
            if journal is None or number not in journal:
                given[number] = frame._replace(scan=_NO_SCAN)  # what a lost one needs
                yield number, frame
            else:
                kept[number] = frame.stamp

    kept: dict[int, float] = {}
    waiting: dict[int, Observed] = {}
    next_number = 0

    def in_turn() -> Iterator[Observed]:
        nonlocal next_number
        while next_number in waiting or next_number in kept:
            if next_number in waiting:
                yield waiting.pop(next_number)
            else:
                assert journal is not None
                yield _restored(journal, next_number, kept.pop(next_number))
            next_number += 1

    for number, seen in (pool or Pool()).run(work, new()):
        frame = given.pop(number)
        if isinstance(seen, Lost):
            seen = Observed(frame.stamp, frame.T_odometry_first, frame.distance, (), seen.reason)
        if journal is not None:
            journal.add(number, {"seen": to_record(seen)})
        waiting[number] = seen
        yield from in_turn()
    yield from in_turn()


_NO_SCAN = Scan(np.zeros((0, 3)))


def _restored(journal: Journal, number: int, stamp: float) -> Observed:
    """What was seen at a keyframe in a run that was stopped."""
    seen = from_record(Observed, journal[number].get("seen"), f"{journal.path}: keyframe {number}")
    assert isinstance(seen, Observed)
    if seen.stamp != stamp:
        raise InputError(
            f"{journal.path}: keyframe {number} is at {seen.stamp} s, in the recording at {stamp} s: the file is of "
            "another run; remove it"
        )
    return seen


def _reason(error: Exception) -> str:
    """The error without the scan's name, so that equal ones are counted together."""
    return str(error).split(": ", 1)[-1]
