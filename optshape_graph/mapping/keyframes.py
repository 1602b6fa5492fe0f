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
from optshape_graph.mapping.odometry import OdometryTrack
from optshape_graph.mapping.sweep import Sweep
from optshape_graph.scan import Scan, rings_missing
from optshape_graph.se3 import angle, inverse


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


HALF_REVOLUTION = 0.05
"""Seconds before and after the stamp of a scan whose returns have no times: over those its motion is looked at."""


NO_ODOMETRY = "no odometry at its time"
"""Why a scan is skipped that the odometry does not reach."""


class Keyframe(NamedTuple):
    """A scan to be used, with where odometry has it.

    Attributes:
        stamp: seconds.
        scan: as recorded.
        sweep: motion of the LiDAR about it; None: no odometry.
        distance: metres gone since the keyframe before.
        linked: whether that motion leads from keyframe to keyframe, and not within the scan only.
    """

    stamp: float
    scan: Scan
    sweep: Sweep | None
    distance: float
    linked: bool = True

    @property
    def T_odometry_lidar(self) -> Floats | None:
        """(4, 4) at the stamp; None: no odometry."""
        return self.sweep.T_odometry_lidar if self.sweep is not None and self.linked else None


@dataclass
class Progress:
    """What a run has come to, to be shown while it goes on.

    Attributes:
        scans: read.
        keyframes: of those used.
        sightings: targets seen in them.
        landmarks: in the map.
        skipped: scans that were not used though they should have been, by reason.
        span: seconds, of the first and the last scan read; None before there is one.
        expected: number of scans that the recording says there are, or None.
    """

    scans: int = 0
    keyframes: int = 0
    sightings: int = 0
    landmarks: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    span: tuple[float, float] | None = None
    expected: int | None = None


def keyframes(
    scans: Iterable[Stamped[Scan]],
    odometry: OdometryTrack | None,
    policy: KeyframePolicy,
    progress: Progress,
    unknown: Sweep | None = None,
) -> Iterator[Keyframe]:
    """Choose keyframes of a stream of scans.

    Without odometry every scan that the policy's time allows is one. A scan before the odometry begins or after it
    ends is skipped and counted.

    Args:
        scans: in order of time.
        odometry: of the LiDAR; None: there is none.
        policy: which scans are used.
        progress: counts what happens.
        unknown: the motion within each scan where there is no odometry; None: the LiDAR is at rest.

    Raises:
        InputError: the first scan has no rings: no target would be found.
    """
    last: tuple[float, Floats] | None = None
    before: Floats | None = None
    distance = 0.0
    for stamp, scan in ((item.stamp, item.value) for item in scans):
        progress.scans += 1
        progress.span = (stamp if progress.span is None else progress.span[0], stamp)
        if not len(scan):
            progress.skipped["empty"] += 1
            continue
        if scan.ring is None and not progress.keyframes:
            raise rings_missing(scan)
        if odometry is None:
            if last is None or not np.isfinite(policy.seconds) or stamp - last[0] >= policy.seconds:
                last = stamp, np.eye(4)
                progress.keyframes += 1
                yield Keyframe(stamp, scan, unknown, 0.0, linked=False)
            continue
        sweep = odometry.sweep(stamp, *_spread(scan))
        if sweep is None:
            progress.skipped[NO_ODOMETRY] += 1
            continue
        T = sweep.T_odometry_lidar
        if before is not None:
            distance += float(np.linalg.norm(T[:3, 3] - before[:3, 3]))
        before = T
        if last is None or policy.wants(inverse(last[1]) @ T, stamp - last[0]):
            last = stamp, T
            progress.keyframes += 1
            yield Keyframe(stamp, scan, sweep, distance)
            distance = 0.0


def _spread(scan: Scan) -> tuple[float, float]:
    """The times of the first and the last return, seconds from the stamp."""
    if scan.time is None:
        return -HALF_REVOLUTION, HALF_REVOLUTION
    return float(scan.time.min()), float(scan.time.max())


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
            skipped.add(BadMessage("stamp duplicated", f"{stamp} s"), str(view.cloud))
            continue
        try:
            scan = read_scan(view.cloud, session.lidars[view.lidar], unused=skipped.unused)
        except InputError as error:
            skipped.add(BadMessage("unreadable file", str(error)), str(view.cloud))
            continue
        last = stamp
        yield Stamped(stamp, scan)
