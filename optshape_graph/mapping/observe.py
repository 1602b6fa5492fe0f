"""What a keyframe's scan shows: the targets in it, each where it was when the LiDAR stood at the scan's stamp."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.detection import Detection, Search, detect_in_scans
from optshape_graph.errors import InputError
from optshape_graph.io.records import from_record, to_record
from optshape_graph.mapping.keyframes import HALF_REVOLUTION, Keyframe
from optshape_graph.mapping.motion import at_own_time, deskew
from optshape_graph.mapping.shapes import shape_measurement
from optshape_graph.mapping.sweep import Sweep
from optshape_graph.mapping.track import Sighting
from optshape_graph.runs.journal import Journal
from optshape_graph.runs.tasks import batches
from optshape_graph.runs.workers import Lost, Pool
from optshape_graph.scan import Scan
from optshape_graph.target import Target

SLOW = np.array([0.01] * 3 + [0.02] * 3)
"""Twist, rad/s and m/s, below which a scan counts as taken at rest: a millimetre in half a revolution."""

AT_ONCE = 8
"""Keyframes whose scans are searched at once."""


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


def observe(
    keyframes: Sequence[Keyframe], targets: Sequence[Target], named: bool, shapes: bool, biases: bool = True
) -> list[Observed]:
    """Find the targets in the scans of keyframes, all at once, and move them to the scans' stamps.

    A scan with times is deskewed: whatever the LiDAR did in between is a known motion. Outlines are straight then; but
    since the motion lifts returns off their rings, poses are estimated at each target's own time, in whose frame rings
    are where they were fired.

    Args:
        keyframes: the scans and their motions.
        targets: to look for.
        named: whether there is one of each template, so that the template is the landmark's name.
        shapes: whether to keep what refines the vertices.
        biases: whether to keep what tells the biases of the LiDAR's rings: a few kilobytes for each sighting.
    """
    found = detect_in_scans([_search(frame, targets) for frame in keyframes])
    return [
        Observed(frame.stamp, frame.T_odometry_first, frame.distance, (), _reason(seen))
        if isinstance(seen, InputError)
        else Observed(
            frame.stamp,
            frame.T_odometry_first,
            frame.distance,
            tuple(
                _sighting(frame, one, named, shapes, biases)
                for one in seen.found
                # It is known which target it is, and where.
                if (one.rival is None or one.status != "ambiguous") and one.estimate.usable
            ),
            "",
        )
        for frame, seen in zip(keyframes, found, strict=True)
    ]


def _motion(frame: Keyframe) -> Sweep | None:
    """The motion by which a scan is set right; None: it was taken at rest, or has no times."""
    sweep = frame.sweep
    return None if sweep is None or frame.scan.time is None or (np.abs(sweep.twist) <= SLOW).all() else sweep


def _search(frame: Keyframe, targets: Sequence[Target]) -> Search:
    scan, motion = frame.scan, _motion(frame)
    if motion is None:
        return Search(scan, targets)

    def fired(rows: Ints) -> tuple[Scan, Floats]:
        returns, at = at_own_time(scan, rows, motion)
        return returns, motion.between(0.0, at)

    return Search(deskew(scan, motion), targets, fired)


def _sighting(frame: Keyframe, detection: Detection, named: bool, shapes: bool, biases: bool) -> Sighting:
    """A target from the scan's stamp, of several LiDARs from the first of them."""
    scan, rows, estimate, motion = frame.scan, detection.indices, detection.estimate, _motion(frame)
    shape = None
    if shapes and estimate.status == "ok":
        returns = scan.select(rows) if motion is None else at_own_time(scan, rows, motion)[0]
        shape = shape_measurement(estimate, returns)
    seen = Sighting.of(estimate, detection.target.name if named else None, shape, biases=biases)
    if frame.sweep is not None:
        at = None if scan.time is None else float(scan.time[rows].mean())
        T = np.eye(4) if motion is None or at is None else motion.between(0.0, at)
        seen = seen.moved(T, _uncertainty(at, frame.sweep))
    first = frame.T_first_lidar
    return replace(seen, lidar=frame.lidar) if first is None else seen.on_body(first, frame.lidar)


def _uncertainty(at: float | None, sweep: Sweep) -> Floats:
    """How well the motion from a scan's stamp to a time is known (6, 6), rotation first.

    Without a time, that is any within half a revolution of the stamp.
    """
    if at is None:
        return np.outer(sweep.twist, sweep.twist) * HALF_REVOLUTION**2 / 3.0
    return sweep.uncertainty(0.0, at)


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
    pool, numbered = pool or Pool(), batches(enumerate(frames), AT_ONCE)
    given: dict[int, tuple[Keyframe, ...]] = {}  # those that are with a worker
    kept: dict[int, float] = {}
    waiting: dict[int, Observed] = {}
    next_number = 0

    def new() -> Iterator[tuple[int, tuple[Keyframe, ...]]]:
        for batch in numbered:
            some, first = tuple(frame for _, frame in batch), batch[0][0]
            if journal is not None and all(number in journal for number, _ in batch):
                kept.update((number, frame.stamp) for number, frame in batch)
            else:
                given[first] = some
                yield first, some

    def in_turn() -> Iterator[Observed]:
        nonlocal next_number
        while next_number in waiting or next_number in kept:
            if next_number in waiting:
                yield waiting.pop(next_number)
            else:
                assert journal is not None
                yield _restored(journal, next_number, kept.pop(next_number))
            next_number += 1

    for first, together in pool.run(work, new()):
        some = given.pop(first)
        seen = _one_by_one(work, some, pool) if isinstance(together, Lost) else together
        for number, one in enumerate(seen, start=first):
            if journal is not None and number not in journal:
                journal.add(number, {"seen": to_record(one)})
            waiting[number] = one
        yield from in_turn()
    yield from in_turn()


def _one_by_one(
    work: Callable[[tuple[Keyframe, ...]], list[Observed]], frames: Sequence[Keyframe], pool: Pool
) -> list[Observed]:
    """Observe keyframes with which a worker was killed twice, each by itself, so that only the one to blame is lost."""
    found: dict[int, Observed] = {}
    for number, seen in pool.run(work, ((number, (frame,)) for number, frame in enumerate(frames))):
        frame = frames[number]
        if isinstance(seen, Lost):
            found[number] = Observed(frame.stamp, frame.T_odometry_first, frame.distance, (), seen.reason)
        else:
            (found[number],) = seen
    return [found[number] for number in range(len(frames))]


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
