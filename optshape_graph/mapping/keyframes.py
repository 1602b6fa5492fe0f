"""Which scans of a recording are used, and where odometry has them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.io.clouds import read_scan
from optshape_graph.io.recordings.stream import BadMessage, Skipped, Stamped
from optshape_graph.io.sessions import Session
from optshape_graph.mapping.motion import twist_between
from optshape_graph.scan import Scan
from optshape_graph.se3 import PoseLike, angle, as_transform, exp, inverse


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
        moved = float(np.linalg.norm(motion[:3, 3]))
        return bool(moved >= self.distance or angle(motion) >= self.angle or seconds >= self.seconds)


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

    def __init__(self, poses: Iterable[Stamped[Floats]], T_body_lidar: PoseLike | None = None) -> None:
        self.T_body_lidar = np.eye(4) if T_body_lidar is None else as_transform(T_body_lidar, "T_body_lidar")
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
                moved = exp((stamp - before.stamp) * twist)
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
