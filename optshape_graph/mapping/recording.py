"""From a recording to a map: scans become sightings at keyframes, poses become odometry between them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError, MissingExtraError, UnobservableError, expect
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.recordings import ClockOffset, Recording, Skipped, Stamped, Stream
from optshape_graph.io.recordings.topics import Mounting
from optshape_graph.io.sessions import Session
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.mapping.batch import solve_batch
from optshape_graph.mapping.batch_solution import BatchSolution
from optshape_graph.mapping.clocks import Clocks, offset_of
from optshape_graph.mapping.incremental import LandmarkSlam
from optshape_graph.mapping.keyframes import NO_ODOMETRY, Keyframe, KeyframePolicy, Progress, keyframes, keyframes_of
from optshape_graph.mapping.map import Map
from optshape_graph.mapping.observe import Observed, observe, observe_all
from optshape_graph.mapping.odometry import OdometryTrack
from optshape_graph.mapping.registration import NOISE, moves, scan_odometry, unknown_motion
from optshape_graph.mapping.source import Lidar, Source, Transforms, open_source, read_extrinsics, session_scans
from optshape_graph.mapping.sweep import MotionNoise, Sweep
from optshape_graph.runs.journal import Journal
from optshape_graph.runs.workers import Pool
from optshape_graph.se3 import PoseLike, inverse
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

__all__ = [
    "Clocks", "Keyframe", "KeyframePolicy", "Lidar", "MapResult", "MotionNoise", "Observed", "OdometryTrack",
    "Progress", "build_map", "keyframes", "keyframes_of", "map_recording", "observe", "observe_all", "read_extrinsics",
    "session_scans",
]  # fmt: skip

MANY = 60
"""Scans from which on several processes are worth their start."""

MOST_LOST = 0.5
"""Share of the scans with which lost a map is not to be trusted to show what was there."""

SOME_CONTRADICT, MANY_CONTRADICT = 0.05, 0.2
"""Shares of the sightings that contradict a map, above which it says so, and is not to be trusted. By chance one in a
thousand does."""

FEWEST_CONTRADICTING = 3
"""Sightings that contradict a map, below which it is not told from clutter."""


@dataclass(frozen=True, eq=False)
class MapResult:
    """What a recording has come to.

    Attributes:
        map: the landmarks, and the trajectory under the session's name.
        session: name of the session.
        solution: of everything at once; None: it was not asked for, or there is nothing to solve for.
        counts: of sightings, by what became of them.
        progress: of the run: scans, keyframes, sightings, and scans skipped by reason.
        skipped: messages of the recording that could not be used, by reason.
        passed_over: what was not used of scans and odometry, those skipped by `skipped` and `progress` among them.
        mounting: where the LiDAR is on the body that the odometry is of, as the recording has it; None: it was given,
            or there is no odometry.
        clocks: of scans and odometry.
        warnings: what was taken for granted, in words.
        problems: why the map is not to be trusted, in words; empty: nothing says so.
    """

    map: Map
    session: str
    solution: BatchSolution | None
    counts: Mapping[str, int]
    progress: Progress
    skipped: Skipped
    passed_over: PassedOver
    mounting: Mounting | None = None
    clocks: Clocks = field(default_factory=Clocks)
    warnings: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()

    def __repr__(self) -> str:
        state = "" if not self.problems else f", {len(self.problems)} problems"
        return f"MapResult({len(self.map.landmarks)} landmarks, {len(self.trajectory)} poses{state})"

    def _repr_html_(self) -> str:
        return self.map._repr_html_()

    @property
    def trajectory(self) -> Trajectory:
        """T_world_lidar over time, of several LiDARs that of the first."""
        return self.map.trajectories[self.session]


def map_recording(
    recording: str | Path | Recording | Session,
    targets: Target | Sequence[Target] = (),
    sensor: SensorModel | Mapping[str, SensorModel] | None = None,
    *,
    scans: str | Sequence[str] | None = None,
    odometry: str | Path | Trajectory | None = None,
    mounting: PoseLike | Mapping[str, PoseLike] | None = None,
    extrinsics: Transforms | None = None,
    clock_offset: float | Literal["auto"] = 0.0,
    known: Map | None = None,
    one_each: bool = False,
    keyframe: KeyframePolicy | None = None,
    noise: MotionNoise | None = None,
    confirmations: int | None = None,
    lag: float | None = None,
    batch: bool = True,
    as_built_sigma: float | None = None,
    pool: Pool | None = None,
    journal: Journal | None = None,
    report: Callable[[Progress], None] | None = None,
) -> MapResult:
    """Map the targets that a recording saw, and where it saw them from.

    Scans are placed by odometry, and by what they have in common with others; without odometry, by that alone. Scans
    that cannot be used are skipped with a reason and counted. Several LiDARs of one robot make one map; its poses are
    of the first. A clock that was set in between is followed.

    Args:
        recording: a ROS 1 or ROS 2 bag, an .mcap file, a folder of clouds with timestamps.txt, or a session (.yaml),
            by its path or opened.
        targets: to look for; a session names its own.
        sensor: the LiDAR, or of each topic of scans its own; a session names its own.
        scans: topic of the scans, or topics of several LiDARs on one robot; None: the only one.
        odometry: topic of poses, a TUM file, or a trajectory; "none" for none; None: the only topic of poses, if there
            is one.
        mounting: T_body_lidar (4, 4) on the body that the odometry is of, of the first LiDAR, or by topic (in a
            session by the LiDAR's name); None: the recording's static transforms.
        extrinsics: T_a_b (4, 4) by the names of frames a and b, as of `read_extrinsics`, beside the recording's own:
            where LiDARs are.
        clock_offset: seconds to add to the stamps of the odometry to have those of the scans; "auto": estimated, by how
            fast scans and odometry say that the robot turned.
        known: map to start from: surveyed landmarks, or one made before.
        one_each: there is one of each target: its name is the landmark's.
        keyframe: which scans are used; None: after half a metre or ten degrees.
        noise: of the odometry; None: 2 cm and 0.2 deg per square root of a metre.
        confirmations: sightings that must agree on a new landmark; None: 2, or 1 without odometry.
        lag: seconds of poses that are kept in the graph; None: all.
        batch: solve for everything at once at the end.
        as_built_sigma: standard deviation to which the targets were built, metres: refines their vertices; None:
            templates are exact.
        pool: what detects targets; None: a process for each core, for recordings of many scans.
        journal: keeps what is seen, so that a run that was stopped goes on where it was; None: nothing is kept.
        report: called after every keyframe.

    Raises:
        InputError: no such recording, topic or file, no targets, a LiDAR of several whose place is not known,
            stamps that do not follow, or `as_built_sigma` without the batch solution.
        MissingExtraError: kiss-icp is absent, which the estimate of the clock offset needs.
        UnobservableError: the motion does not tell the clock offset.
    """
    if as_built_sigma is not None and (lag is not None or not batch):
        raise InputError("as-built vertices need the batch solution, so no lag, and a batch")
    expect("recording", recording, str, Path, Recording, Session)
    wanted = [targets] if isinstance(targets, Target) else list(targets)
    for target in wanted:
        expect("targets", target, Target)
    source = open_source(recording, wanted, sensor, scans, odometry, mounting, extrinsics)
    offset = _offset(source, clock_offset)
    track, unknown = _track(source, noise, offset)
    noise = MotionNoise() if track is None else track.noise
    progress = Progress(expected=source.expected)
    slam = LandmarkSlam(known, lag=lag, confirmations=confirmations or (1 if track is None else 2), name=source.name)
    seen = observe_all(
        keyframes_of(source.lidars, track, keyframe or KeyframePolicy(), progress, unknown),
        source.targets,
        one_each,
        as_built_sigma is not None,
        pool or Pool(_processes(source.expected)),
        biases=batch and lag is None,
        journal=journal,
    )
    build_map(slam, seen, noise, progress, report)
    slam.settle()
    result, solution = slam.map(), None
    if batch and lag is None and result.landmarks:
        solution = solve_batch(slam.problem(), as_built_sigma=as_built_sigma)
        result = solution.map()
    read = None if track is None or track.span is None or source.poses is None else track.span
    own = None if read is None else (read[0] - offset[0], read[1] - offset[0])
    clocks = Clocks(progress.span, own, *offset, source.jumps)
    contradict, many = _contradictions(slam.counts)
    return MapResult(
        result, source.name, solution, dict(slam.counts), progress, source.skipped,
        source.passed_over(progress.skipped), source.mounting, clocks,
        (*source.warnings, *(() if many else contradict)),
        (*_problems(result, source, clocks, progress), *(contradict if many else ())),
    )  # fmt: skip


def build_map(
    slam: LandmarkSlam,
    observed: Iterable[Observed],
    noise: MotionNoise,
    progress: Progress,
    report: Callable[[Progress], None] | None = None,
) -> None:
    """Feed what was seen into landmark SLAM.

    Args:
        slam: to feed.
        observed: what was seen at each keyframe, in order of time.
        noise: of the odometry.
        progress: counts what happens.
        report: called after every keyframe.

    Raises:
        InputError: a stamp or odometry that does not follow.
    """
    before: Observed | None = None
    for seen in observed:
        if seen.failure:
            progress.skipped[seen.failure] += 1
        if before is None:
            slam.add_odometry(seen.stamp)
        elif seen.stamp > before.stamp:  # several LiDARs may fire at once, from one pose
            seconds = seen.stamp - before.stamp
            if seen.T_odometry_lidar is None or before.T_odometry_lidar is None:
                slam.add_odometry(seen.stamp)
            else:
                motion = inverse(before.T_odometry_lidar) @ seen.T_odometry_lidar
                slam.add_odometry(seen.stamp, motion, noise.covariance(seen.distance, seconds))
        slam.add_measurements(seen.sightings)
        progress.sightings += len(seen.sightings)
        progress.landmarks = len(slam.landmark_names)
        before = seen
        if report is not None:
            report(progress)


def _offset(source: Source, clock_offset: float | Literal["auto"]) -> tuple[float, float | None]:
    """The clock offset, seconds, and its standard deviation where it was estimated.

    Raises:
        InputError: there is no odometry to estimate it for.
        UnobservableError: the motion does not tell it.
    """
    if clock_offset != "auto":
        return float(clock_offset), None
    if source.poses is None:
        raise InputError(f"{source.name}: no odometry whose clock could be offset")
    try:
        found: ClockOffset = offset_of(source.lidars[0].scans, source.poses)
    except UnobservableError as error:
        raise UnobservableError(f"{source.name}: {error}; --clock-offset SECONDS gives it", error.directions) from error
    return found.seconds, found.standard_deviation


def _track(
    source: Source, noise: MotionNoise | None, offset: tuple[float, float | None]
) -> tuple[OdometryTrack | None, Sweep | None]:
    """The odometry of a source, if there is any, else the motion within a scan; warns of what is taken for granted."""
    if source.poses is None:
        return _unknown(source, noise)
    seconds, sd = offset
    poses: Iterable[Stamped[Floats]] = source.poses
    if seconds:
        poses = (Stamped(pose.stamp + seconds, pose.value) for pose in source.poses)
    return OdometryTrack(poses, source.T_body_lidar, noise or MotionNoise(), sd or 0.0), None


def _unknown(source: Source, noise: MotionNoise | None) -> tuple[OdometryTrack | None, Sweep | None]:
    """What stands for odometry where there is none: scans of a LiDAR that moves tell its motion themselves."""
    first = source.lidars[0].scans
    if not isinstance(first, Stream) or not moves(first):
        source.warnings.append("no odometry: every scan is taken for one made at rest")
        return None, None
    try:
        poses = list(scan_odometry(first))
    except MissingExtraError as error:
        source.warnings.append(
            "no odometry, and the LiDAR moves: targets are off by what it moves within a revolution, which their "
            f"covariances say. To have its motion from the scans: {error}"
        )
        return None, unknown_motion(source.expected or 1)
    source.warnings.append("no odometry: the LiDAR's motion is taken from the scans, by KISS-ICP")
    return OdometryTrack(poses, None, noise or NOISE), None


def _problems(result: Map, source: Source, clocks: Clocks, progress: Progress) -> tuple[str, ...]:
    """Why a map is not to be trusted to show what was there."""
    problems = []
    if not result.landmarks:
        problems.append("no target was mapped")
    skipped = source.skipped.total()
    lost, total = progress.skipped.total() + skipped, progress.scans + skipped
    if total and lost >= MOST_LOST * total:
        problems.append(f"{lost} of {total} scans were lost")
    outside = progress.skipped[NO_ODOMETRY]
    if clocks.odometry is not None and outside and outside >= MOST_LOST * progress.scans:
        which = "no scan lies" if outside == progress.scans else f"{outside} of {progress.scans} scans do not lie"
        problems.append(f"{which} within the odometry: {clocks.spans}: is a clock offset needed?")
    return tuple(problems)


def _contradictions(counts: Counter[str]) -> tuple[tuple[str, ...], bool]:
    """Say how many sightings contradict the map, where that is more than clutter explains; and whether they are many.

    Where odometry is wrong, or its noise larger than said, the graph goes on without the sightings that show it.
    """
    rejected, taken = counts["rejected"], counts["matched"] + counts["new"] + counts["rejected"]
    if rejected < FEWEST_CONTRADICTING or rejected < SOME_CONTRADICT * taken:
        return (), False
    text = (
        f"{rejected} of {taken} sightings contradict the map, and are left out of it: is the odometry the LiDAR's "
        "(--mounting), and its noise right (--odometry-noise)? Was a target moved?"
    )
    return (text,), rejected >= MANY_CONTRADICT * taken


def _processes(expected: int | None) -> int:
    """Processes for a recording: starting them takes about as long as detecting targets in MANY scans."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return cores if expected is None or expected >= MANY else 1
