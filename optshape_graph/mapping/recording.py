"""From a recording to a map: scans become sightings at keyframes, poses become odometry between them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError, MissingExtraError
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.recordings import Recording, Skipped, Stamped, Stream
from optshape_graph.io.recordings.topics import Mounting
from optshape_graph.io.sessions import Session, load_session
from optshape_graph.io.trajectories import Trajectory, is_trajectory, read_trajectory
from optshape_graph.mapping.batch import solve_batch
from optshape_graph.mapping.batch_solution import BatchSolution
from optshape_graph.mapping.incremental import LandmarkSlam
from optshape_graph.mapping.keyframes import NO_ODOMETRY, Keyframe, KeyframePolicy, Progress, keyframes, session_scans
from optshape_graph.mapping.map import Map
from optshape_graph.mapping.observe import Observed, observe, observe_all
from optshape_graph.mapping.odometry import OdometryTrack
from optshape_graph.mapping.registration import NOISE, moves, scan_odometry, unknown_motion
from optshape_graph.mapping.sweep import MotionNoise, Sweep
from optshape_graph.runs.journal import Journal
from optshape_graph.runs.workers import Pool
from optshape_graph.scan import Scan
from optshape_graph.se3 import PoseLike, as_transform, inverse
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

__all__ = [
    "Keyframe", "KeyframePolicy", "MapResult", "MotionNoise", "Observed", "OdometryTrack", "Progress", "build_map",
    "keyframes", "map_recording", "observe", "observe_all", "session_scans",
]  # fmt: skip

MANY = 60
"""Scans from which on several processes are worth their start."""

MOST_LOST = 0.5
"""Share of the scans that may be lost before a map is not to be trusted to show what was there."""


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
    warnings: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()

    def __repr__(self) -> str:
        state = "" if not self.problems else f", {len(self.problems)} problems"
        return f"MapResult({len(self.map.landmarks)} landmarks, {len(self.trajectory)} poses{state})"

    def _repr_html_(self) -> str:
        return self.map._repr_html_()

    @property
    def trajectory(self) -> Trajectory:
        """T_world_lidar over time."""
        return self.map.trajectories[self.session]


@dataclass(eq=False)
class _Source:
    """What is mapped: a recording or a session, opened."""

    name: str
    scans: Iterable[Stamped[Scan]]
    expected: int | None
    skipped: Callable[[], Skipped]
    targets: Sequence[Target]
    poses: Iterable[Stamped[Floats]] | None = None
    mounting: Mounting | None = None
    warnings: list[str] = field(default_factory=list)


def map_recording(
    recording: str | Path | Recording | Session,
    targets: Target | Sequence[Target] = (),
    sensor: SensorModel | None = None,
    *,
    scans: str | None = None,
    odometry: str | Path | Trajectory | None = None,
    mounting: PoseLike | None = None,
    clock_offset: float = 0.0,
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
    that cannot be used are skipped with a reason and counted.

    Args:
        recording: a ROS 1 or ROS 2 bag, an .mcap file, a folder of clouds with timestamps.txt, or a session (.yaml),
            by its path or opened.
        targets: to look for; a session names its own.
        sensor: the LiDAR; a session names its own.
        scans: topic of the scans; None: the only one.
        odometry: topic of poses, a TUM file, or a trajectory; "none" for none; None: the only topic of poses, if there
            is one.
        mounting: T_body_lidar (4, 4) on the body that the odometry is of; None: the recording's static transforms.
        clock_offset: seconds to add to the stamps of the odometry to have those of the scans.
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
        InputError: no such recording, topic or file, no targets, stamps that do not follow, or `as_built_sigma`
            without the batch solution.
    """
    if as_built_sigma is not None and (lag is not None or not batch):
        raise InputError("as-built vertices need the batch solution, so no lag, and a batch")
    source = _opened(recording, [targets] if isinstance(targets, Target) else list(targets), sensor, scans, odometry)
    track, unknown = _track(source, mounting, noise, clock_offset)
    noise = MotionNoise() if track is None else track.noise
    progress = Progress(expected=source.expected)
    slam = LandmarkSlam(known, lag=lag, confirmations=confirmations or (1 if track is None else 2), name=source.name)
    seen = observe_all(
        keyframes(source.scans, track, keyframe or KeyframePolicy(), progress, unknown),
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
    return MapResult(
        result, source.name, solution, dict(slam.counts), progress, source.skipped(),
        _passed_over(source, progress), source.mounting,
        tuple(source.warnings), _problems(result, source, track, progress),
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
        else:
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


def _opened(
    recording: str | Path | Recording | Session,
    targets: Sequence[Target],
    sensor: SensorModel | None,
    scans: str | None,
    odometry: str | Path | Trajectory | None,
) -> _Source:
    """Open a recording or a session, with its odometry."""
    if isinstance(recording, str | Path) and Path(recording).suffix.lower() in (".yaml", ".yml", ".json"):
        recording = load_session(recording)
    if isinstance(odometry, str | Path) and is_trajectory(odometry):
        odometry = read_trajectory(odometry)
    poses = _stamped(odometry) if isinstance(odometry, Trajectory) else None
    if isinstance(recording, Session):
        if targets or sensor or scans:
            raise InputError(f"{recording.path}: a session names its own targets, sensor and scans")
        if odometry not in (None, "none") and poses is None:
            raise InputError(f"{recording.path}: a session has no topic '{odometry}'; odometry comes from a file")
        missed = Skipped()
        return _Source(
            recording.path.stem, session_scans(recording, missed), len(recording.views), lambda: missed,
            list(recording.targets.values()), poses,
        )  # fmt: skip
    if not targets:
        raise InputError("no targets: what is to be looked for in the recording")
    opened = recording if isinstance(recording, Recording) else Recording(recording)
    stream = opened.scans(scans, sensor)
    source = _Source(opened.path.stem, stream, stream.expected, lambda: stream.skipped, targets, poses)
    topic = odometry if isinstance(odometry, str) else None
    if poses is None and odometry != "none" and (topic or any(t.kind == "pose" for t in opened.topics)):
        source.poses = opened.poses(topic)
        source.mounting = opened.mounting(scans, topic)
    return source


def _stamped(trajectory: Trajectory) -> list[Stamped[Floats]]:
    if trajectory.stamps is None:
        raise InputError(f"{trajectory.name}: odometry needs stamps")
    return [Stamped(float(stamp), T) for stamp, T in zip(trajectory.stamps, trajectory.poses, strict=True)]


def _track(
    source: _Source, mounting: PoseLike | None, noise: MotionNoise | None, clock_offset: float
) -> tuple[OdometryTrack | None, Sweep | None]:
    """The odometry of a source, if there is any, else the motion within a scan; warns of what is taken for granted."""
    if source.poses is None:
        return _unknown(source, noise)
    T_body_lidar = None if mounting is None else as_transform(mounting, "mounting")
    found, source.mounting = source.mounting, None if mounting is not None else source.mounting
    if mounting is None and found is not None:
        T_body_lidar = found.T_body_lidar
        if T_body_lidar is None and found.body and found.lidar:
            source.warnings.append(
                f"odometry is of '{found.body}', scans are in '{found.lidar}', and no static transform links them: "
                "taken for one frame; --mounting says where the LiDAR is"
            )
    poses = source.poses
    if clock_offset:
        poses = (Stamped(pose.stamp + clock_offset, pose.value) for pose in poses)
    return OdometryTrack(poses, T_body_lidar, noise or MotionNoise()), None


def _unknown(source: _Source, noise: MotionNoise | None) -> tuple[OdometryTrack | None, Sweep | None]:
    """What stands for odometry where there is none: scans of a LiDAR that moves tell its motion themselves."""
    if not isinstance(source.scans, Stream) or not moves(source.scans):
        source.warnings.append("no odometry: every scan is taken for one made at rest")
        return None, None
    try:
        poses = list(scan_odometry(source.scans))
    except MissingExtraError as error:
        source.warnings.append(
            "no odometry, and the LiDAR moves: targets are off by what it moves within a revolution, which their "
            f"covariances say. To have its motion from the scans: {error}"
        )
        return None, unknown_motion(source.expected or 1)
    source.warnings.append("no odometry: the LiDAR's motion is taken from the scans, by KISS-ICP")
    return OdometryTrack(poses, None, noise or NOISE), None


def _problems(result: Map, source: _Source, track: OdometryTrack | None, progress: Progress) -> tuple[str, ...]:
    """Why a map is not to be trusted to show what was there."""
    problems = []
    if not result.landmarks:
        problems.append("no target was mapped")
    lost = progress.skipped.total() + sum(source.skipped().values())
    total = progress.scans + sum(source.skipped().values())
    if total and lost > MOST_LOST * total:
        problems.append(f"{lost} of {total} scans were lost")
    outside = progress.skipped[NO_ODOMETRY]
    if track is not None and progress.scans and outside == progress.scans:
        problems.append(f"no scan lies within the odometry: scans are {_span(progress.span)}, odometry is "
                        f"{_span(track.span)}: is a clock offset needed?")  # fmt: skip
    return tuple(problems)


def _passed_over(source: _Source, progress: Progress) -> PassedOver:
    skipped = source.skipped()
    found = PassedOver({"scans": progress.skipped + skipped}, {"scans": skipped.unused})
    if isinstance(source.poses, Stream):
        found.skipped[f"messages of {source.poses.name}"] = Counter(source.poses.skipped)
    return found


def _span(span: tuple[float, float] | None) -> str:
    return "empty" if span is None else f"from {span[0]:.3f} to {span[1]:.3f} s"


def _processes(expected: int | None) -> int:
    """Processes for a recording: starting them takes about as long as detecting targets in MANY scans."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return cores if expected is None or expected >= MANY else 1
