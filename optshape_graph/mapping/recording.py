"""A recording as landmark SLAM sees it: scans become sightings at keyframes, poses become odometry between them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from typing import NamedTuple

import gtsam
import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.detection import detect_targets
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.factors.se3 import inverse
from optshape_graph.io.clouds import read_scan
from optshape_graph.io.recordings.stream import BadMessage, Skipped, Stamped
from optshape_graph.io.sessions import Session
from optshape_graph.mapping.incremental import LandmarkSlam
from optshape_graph.mapping.motion import deskew, estimate_moving, twist_between
from optshape_graph.mapping.shapes import shape_measurement
from optshape_graph.mapping.sighting import Sighting
from optshape_graph.pose import PoseEstimate
from optshape_graph.scan import Scan
from optshape_graph.target import Target

SLOW = np.array([0.01] * 3 + [0.02] * 3)
"""Twist, rad/s and m/s, below which a scan counts as taken at rest: a millimetre in half a revolution."""

OFF_ITS_RING = 0.25
"""Share of the gap between rings by which deskewing may lift returns off their elevation: with less the estimate is the
same to a fraction of its standard deviation (0.15, root mean square); with more it takes one at the target's own time,
in whose frame rings are where they were fired."""

AHEAD = 2
"""Scans that each worker has waiting: more would only take memory."""


@dataclass(frozen=True)
class KeyframePolicy:
    """Which scans are used. Those of a robot at rest would repeat each other's errors, and say nothing new.

    Attributes:
        distance: metres moved since the last keyframe, or
        angle: rad turned, or
        seconds: passed, from which on a scan is one. Infinite: never for that reason.
    """

    distance: float = 0.5
    angle: float = np.radians(10.0)
    seconds: float = np.inf

    def wants(self, motion: Floats, seconds: float) -> bool:
        """Say whether a scan after a motion (4, 4) and a time is a keyframe."""
        turned = float(np.linalg.norm(gtsam.Rot3.Logmap(gtsam.Rot3(motion[:3, :3]))))
        return float(np.linalg.norm(motion[:3, 3])) >= self.distance or turned >= self.angle or seconds >= self.seconds


@dataclass(frozen=True)
class MotionNoise:
    """Standard deviations of odometry: what it drifts by, each axis, per square root of what it has gone.

    Attributes:
        metres: per square root of a metre, metres.
        radians: per square root of a metre, rad.
        metres_at_rest: per square root of a second, metres.
        radians_at_rest: per square root of a second, rad.
    """

    metres: float = 0.02
    radians: float = np.radians(0.2)
    metres_at_rest: float = 0.005
    radians_at_rest: float = np.radians(0.1)

    def covariance(self, distance: float, seconds: float) -> Floats:
        """(6, 6) of a motion over a distance, metres, and a time, rotation first."""
        rotation = self.radians**2 * distance + self.radians_at_rest**2 * seconds
        translation = self.metres**2 * distance + self.metres_at_rest**2 * seconds
        return np.diag([rotation] * 3 + [translation] * 3)


class OdometryTrack:
    """Poses over time, asked for in order of time, and forgotten when they have passed.

    Args:
        poses: T_odometry_body (4, 4) in order of time.
        T_body_lidar: (4, 4) of the LiDAR on the body; None: they are one.

    Attributes:
        T_body_lidar: (4, 4) of the LiDAR on the body that the poses are of.
    """

    def __init__(self, poses: Iterable[Stamped[Floats]], T_body_lidar: Floats | None = None) -> None:
        self.T_body_lidar = np.eye(4) if T_body_lidar is None else T_body_lidar
        self._poses = iter(poses)
        self._window: list[Stamped[Floats]] = []

    def at(self, stamp: float) -> tuple[Floats, Floats] | None:
        """Return T_odometry_lidar (4, 4) and the LiDAR's twist (6,) at a time; None where no poses are around it.

        Between two poses the motion is of constant twist.
        """
        while len(self._window) < 2 or self._window[-1].stamp < stamp:
            following = next(self._poses, None)
            if following is None:
                break
            self._window.append(following)
            while len(self._window) > 2 and self._window[1].stamp <= stamp:
                del self._window[0]
        for before, after in zip(self._window[:-1], self._window[1:], strict=True):
            if before.stamp <= stamp <= after.stamp:
                step = inverse(before.value @ self.T_body_lidar) @ after.value @ self.T_body_lidar
                twist = twist_between(step, after.stamp - before.stamp)
                moved = gtsam.Pose3.Expmap((stamp - before.stamp) * twist).matrix()
                return before.value @ self.T_body_lidar @ moved, twist
        return None


class Keyframe(NamedTuple):
    """A scan to be used, with where odometry has it.

    Attributes:
        stamp: seconds.
        scan: as recorded.
        T_odometry_lidar: (4, 4) at the stamp; None: no odometry.
        twist: (6,) of the LiDAR, rotation first, rad/s and m/s.
        distance: metres gone since the keyframe before.
    """

    stamp: float
    scan: Scan
    T_odometry_lidar: Floats | None
    twist: Floats
    distance: float


class Observed(NamedTuple):
    """What was seen at a keyframe.

    Attributes:
        stamp: seconds.
        T_odometry_lidar: (4, 4) at the stamp; None: no odometry.
        distance: gone since the keyframe before, metres.
        sightings: of targets.
        failure: why the scan could not be used, else empty.
    """

    stamp: float
    T_odometry_lidar: Floats | None
    distance: float
    sightings: tuple[Sighting, ...]
    failure: str


@dataclass
class Progress:
    """What a run has come to, to be shown while it goes on.

    Attributes:
        scans: read.
        keyframes: of those used.
        sightings: targets seen in them.
        skipped: scans that were not used though they should have been, by reason.
    """

    scans: int = 0
    keyframes: int = 0
    sightings: int = 0
    skipped: Counter[str] = field(default_factory=Counter)


def keyframes(
    scans: Iterable[Stamped[Scan]], odometry: OdometryTrack | None, policy: KeyframePolicy, progress: Progress
) -> Iterator[Keyframe]:
    """Choose keyframes of a stream of scans.

    Without odometry every scan that the policy's time allows is one. A scan before the odometry begins or after it
    ends is skipped and counted.
    """
    last: tuple[float, Floats] | None = None
    before: Floats | None = None
    distance = 0.0
    for stamp, scan in ((item.stamp, item.value) for item in scans):
        progress.scans += 1
        if not len(scan):
            progress.skipped["empty"] += 1
            continue
        if odometry is None:
            if last is None or not np.isfinite(policy.seconds) or stamp - last[0] >= policy.seconds:
                last = stamp, np.eye(4)
                progress.keyframes += 1
                yield Keyframe(stamp, scan, None, np.zeros(6), 0.0)
            continue
        found = odometry.at(stamp)
        if found is None:
            progress.skipped["no odometry at its time"] += 1
            continue
        T, twist = found
        if before is not None:
            distance += float(np.linalg.norm(T[:3, 3] - before[:3, 3]))
        before = T
        if last is None or policy.wants(inverse(last[1]) @ T, stamp - last[0]):
            last = stamp, T
            progress.keyframes += 1
            yield Keyframe(stamp, scan, T, twist, distance)
            distance = 0.0


def observe(keyframe: Keyframe, targets: Sequence[Target], named: bool, shapes: bool) -> Observed:
    """Find the targets in a keyframe's scan, moved to the scan's stamp.

    A scan with times is deskewed: whatever the LiDAR did in between is a known motion. Outlines are straight then; but
    where the motion lifts returns off their rings, poses are estimated at each target's own time.

    Args:
        keyframe: the scan and its motion.
        targets: to look for.
        named: whether there is one of each template, so that the template is the landmark's name.
        shapes: whether to keep what refines the vertices.
    """
    scan, twist = keyframe.scan, keyframe.twist
    moving = scan.time is not None and bool((np.abs(twist) > SLOW).any())
    straight = deskew(scan, twist) if moving else scan
    try:
        found = detect_targets(straight, targets).found
    except (EstimationError, InputError) as error:
        return Observed(keyframe.stamp, keyframe.T_odometry_lidar, keyframe.distance, (), _reason(error))
    sightings = []
    for detection in found:
        name = detection.target.name if named else None
        if detection.rival is not None and detection.status == "ambiguous":
            continue  # which target it is, is not known
        fired, returns = scan.select(detection.indices), straight.select(detection.indices)
        if moving and _lifted(fired, returns) > OFF_ITS_RING:
            seen = _moving_sighting(fired, detection.target, twist, name, shapes)
        elif detection.estimate.status != "failed":
            seen = _sighting(detection.estimate, returns, name, shapes)
        else:
            seen = None
        if seen is not None:
            sightings.append(seen)
    return Observed(keyframe.stamp, keyframe.T_odometry_lidar, keyframe.distance, tuple(sightings), "")


def _lifted(fired: Scan, straight: Scan) -> float:
    """Largest change of a return's elevation by deskewing, in the least gap between the rings on the target."""
    before, after = (np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (fired.points, straight.points))
    assert fired.ring is not None  # targets are found ring by ring
    _, ring = np.unique(fired.ring, return_inverse=True)
    of_ring = np.bincount(ring, before) / np.bincount(ring)
    return float(np.abs(after - before).max() / np.diff(of_ring).min())  # four rings at least: it was detected


def _sighting(estimate: PoseEstimate, returns: Scan, name: str | None, shapes: bool) -> Sighting:
    shape = shape_measurement(estimate, returns) if shapes and estimate.status == "ok" else None
    return Sighting.of(estimate, name, shape)


def _moving_sighting(returns: Scan, target: Target, twist: Floats, name: str | None, shapes: bool) -> Sighting | None:
    """A sighting from the scan's stamp, of returns taken while moving; None where they give no pose."""
    try:
        estimate, at = estimate_moving(returns, target, twist)
    except EstimationError:
        return None
    if estimate.status == "failed":
        return None
    sighting = _sighting(estimate, deskew(returns, twist, at), name, shapes)
    return sighting.moved(gtsam.Pose3.Expmap(at * twist).matrix())


def observe_all(
    frames: Iterable[Keyframe], targets: Sequence[Target], named: bool, shapes: bool, workers: int = 1
) -> Iterator[Observed]:
    """Observe keyframes in their order, with several processes, a few scans ahead: memory does not grow."""
    work = partial(observe, targets=tuple(targets), named=named, shapes=shapes)
    if workers == 1:
        yield from map(work, frames)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_one_thread) as pool:
        waiting: list[Future[Observed]] = []
        try:
            for frame in frames:
                waiting.append(pool.submit(work, frame))
                if len(waiting) >= AHEAD * workers:
                    yield waiting.pop(0).result()
            while waiting:
                yield waiting.pop(0).result()
        finally:
            for future in waiting:
                future.cancel()


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
        before = seen
        if report is not None:
            report(progress)


def _one_thread() -> None:
    """Keep the processes from competing for cores with threads of their own, where that can be told."""
    with suppress(ImportError):
        from threadpoolctl import threadpool_limits

        threadpool_limits(1)


def _reason(error: Exception) -> str:
    """The error without the scan's name, so that equal ones are counted together."""
    return str(error).split(": ", 1)[-1]


def session_scans(session: Session, skipped: Skipped) -> Iterator[Stamped[Scan]]:
    """Yield a session's scans by their stamps; without stamps, a second apart in the file's order.

    A file that cannot be read is skipped and counted.

    Raises:
        InputError: stamps of some views only, or several LiDARs.
    """
    stamped = [view for view in session.views if view.stamp is not None]
    if stamped and len(stamped) < len(session.views):
        raise InputError(
            f"{session.path}: {len(stamped)} of {len(session.views)} views have a stamp; expected all or none"
        )
    if len(session.lidars) > 1:
        raise InputError(f"{session.path}: maps are made with one LiDAR, the session has {', '.join(session.lidars)}")
    views = sorted(session.views, key=lambda view: view.stamp or 0.0)
    last = -np.inf
    for k, view in enumerate(views):
        stamp = float(k) if view.stamp is None else view.stamp
        if stamp <= last:
            skipped.add(BadMessage("stamp duplicated", f"{stamp} s"), str(view.scan))
            continue
        try:
            scan = read_scan(view.scan, session.lidars[view.lidar])
        except InputError as error:
            skipped.add(BadMessage("unreadable file", str(error)), str(view.scan))
            continue
        last = stamp
        yield Stamped(stamp, scan)
