"""Which scans of a recording are used, and where odometry has them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.io.recordings.stream import Stamped
from optshape_graph.mapping.odometry import OdometryTrack
from optshape_graph.mapping.source import Lidar, in_turn
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
        lidar: name of the LiDAR, of several on one robot.
        T_first_lidar: (4, 4) of it in the frame of the first of them, whose poses are the map's; None: it is that one.
    """

    stamp: float
    scan: Scan
    sweep: Sweep | None
    distance: float
    linked: bool = True
    lidar: str = ""
    T_first_lidar: Floats | None = None

    @property
    def T_odometry_first(self) -> Floats | None:
        """(4, 4) of the first LiDAR at the stamp; None: no odometry."""
        if self.sweep is None or not self.linked:
            return None
        T = self.sweep.T_odometry_lidar
        return T if self.T_first_lidar is None else T @ inverse(self.T_first_lidar)


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
    """Choose keyframes of the scans of one LiDAR; see `keyframes_of`.

    Args:
        scans: in order of time.
        odometry: of the LiDAR; None: there is none.
        policy: which scans are used.
        progress: counts what happens.
        unknown: the motion within each scan where there is no odometry; None: the LiDAR is at rest.

    Raises:
        InputError: the first scan has no rings: no target would be found.
    """
    return keyframes_of([Lidar("", scans)], odometry, policy, progress, unknown)


def keyframes_of(
    lidars: Sequence[Lidar],
    odometry: OdometryTrack | None,
    policy: KeyframePolicy,
    progress: Progress,
    unknown: Sweep | None = None,
) -> Iterator[Keyframe]:
    """Choose keyframes of the scans of a robot's LiDARs, in order of time, those of each LiDAR by themselves.

    Without odometry every scan that the policy's time allows is one. A scan before the odometry begins or after it
    ends is skipped and counted.

    Args:
        lidars: with their scans.
        odometry: of the first LiDAR; None: there is none.
        policy: which scans are used.
        progress: counts what happens.
        unknown: the motion within each scan where there is no odometry; None: the LiDARs are at rest.

    Raises:
        InputError: the first scan has no rings: no target would be found.
    """
    last: dict[str, tuple[float, Floats]] = {}
    before: Floats | None = None
    distance = 0.0
    for lidar, (stamp, scan) in ((lidar, (item.stamp, item.value)) for lidar, item in in_turn(lidars)):
        progress.scans += 1
        progress.span = (stamp if progress.span is None else progress.span[0], stamp)
        if not len(scan):
            progress.skipped["empty"] += 1
            continue
        if scan.ring is None and not progress.keyframes:
            raise rings_missing(scan)
        mounted = None if lidar is lidars[0] else lidar.T_first_lidar
        if odometry is None:
            since = stamp - last[lidar.name][0] if lidar.name in last else np.inf
            if not np.isfinite(policy.seconds) or since >= policy.seconds:
                last[lidar.name] = stamp, np.eye(4)
                progress.keyframes += 1
                yield Keyframe(stamp, scan, unknown, 0.0, False, lidar.name, mounted)
            continue
        sweep = odometry.sweep(stamp, *_spread(scan), lidar.T_first_lidar)
        if sweep is None:
            progress.skipped[NO_ODOMETRY] += 1
            continue
        frame = Keyframe(stamp, scan, sweep, distance, True, lidar.name, mounted)
        T = frame.T_odometry_first
        assert T is not None  # it is linked
        if before is not None:
            distance += float(np.linalg.norm(T[:3, 3] - before[:3, 3]))
        before = T
        if lidar.name not in last or policy.wants(inverse(last[lidar.name][1]) @ T, stamp - last[lidar.name][0]):
            last[lidar.name] = stamp, T
            progress.keyframes += 1
            yield frame._replace(distance=distance)
            distance = 0.0


def _spread(scan: Scan) -> tuple[float, float]:
    """The times of the first and the last return, seconds from the stamp."""
    if scan.time is None:
        return -HALF_REVOLUTION, HALF_REVOLUTION
    return float(scan.time.min()), float(scan.time.max())
