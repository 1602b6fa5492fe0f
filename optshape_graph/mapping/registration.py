"""Motion of a LiDAR from its scans alone, by KISS-ICP (Vizzo et al., IEEE RA-L 2023): odometry where there is none.

Needs the extra `icp`. Without the library, scans still tell whether the LiDAR moved.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice, pairwise

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import missing_extra
from optshape_graph.io.recordings.stream import Stamped
from optshape_graph.mapping.sweep import MotionNoise, Sweep
from optshape_graph.scan import Scan
from optshape_graph.se3 import difference, exp

NOISE = MotionNoise(0.04, np.radians(1.0), 0.02, np.radians(0.5))
"""Of poses from scans: those of a VLP-16 in a simulated room scatter by 1 cm and 0.25 deg a revolution, at 0.8 m/s."""

VOXELS = 60.0
"""Size of the local map's voxels, as a part of the range that 95 of 100 returns are within."""

CONTINUOUS = 0.5
"""Seconds between scans, beyond which they are placements, not revolutions."""

LOOKED_AT = 10
"""Scans at the beginning that say whether the LiDAR moves."""

AT_REST = 0.03
"""Change of the range in the same direction from scan to scan, median, metres, up to which a LiDAR stands."""

UNKNOWN = Sweep(np.eye(4), np.zeros((2, 6)), np.diag([0.0, 1.0]), jitter=(0.5, 1.0))
"""The motion of a LiDAR of which is known that it moves: by half a radian and a metre a second, standard deviations."""


def scan_odometry(scans: Iterable[Stamped[Scan]]) -> Iterator[Stamped[Floats]]:
    """Yield T_odometry_lidar (4, 4) at the end of every scan, by registering it with those before.

    Args:
        scans: of one LiDAR, with the times of their returns.

    Raises:
        MissingExtraError: kiss-icp is absent.
    """
    try:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP
    except ImportError as error:
        raise missing_extra("kiss-icp", "icp", error) from error
    odometry, before, first = None, None, None
    for stamp, scan in ((item.stamp, item.value) for item in scans):
        if scan.time is None or not len(scan):
            continue
        if odometry is None:
            config = KISSConfig()
            config.data.max_range = float(np.percentile(np.linalg.norm(scan.points, axis=1), 95)) * 1.5
            config.data.min_range = 0.3
            config.mapping.voxel_size = config.data.max_range / 1.5 / VOXELS
            odometry = KissICP(config)
        start, end = float(scan.time.min()), float(scan.time.max())
        odometry.register_frame(np.array(scan.points), (scan.time - start) / max(end - start, 1e-9))
        pose = odometry.last_pose.copy()
        if before is None:
            first = stamp + start
        elif first is not None:  # the first scan began by as much before its end as the second one ended after it
            seconds = stamp + end - before.stamp
            back = (first - before.stamp) / seconds * difference(before.value, pose)
            yield Stamped(first, before.value @ exp(back))
            yield before
            first = None
        if before is not None:
            yield Stamped(stamp + end, pose)
        before = Stamped(stamp + end, pose)


def moves(scans: Iterable[Stamped[Scan]]) -> bool:
    """Say whether scans are revolutions, with times, of a LiDAR that moves: what it sees comes nearer or recedes."""
    first = list(islice(scans, LOOKED_AT))
    if len(first) < 2 or any(scan.value.time is None or scan.value.ring is None for scan in first):
        return False
    if np.median(np.diff([scan.stamp for scan in first])) > CONTINUOUS:
        return False
    images = [_ranges(scan.value) for scan in first]
    changes = [np.abs(b - a)[np.isfinite(a) & np.isfinite(b)] for a, b in pairwise(images)]
    return bool(np.median([np.median(change) for change in changes if len(change)] or [0.0]) > AT_REST)


def _ranges(scan: Scan) -> Floats:
    """Mean range, metres, by ring and degree of azimuth; NaN where there is none."""
    assert scan.ring is not None  # it was asked before
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0])).astype(int) % 360
    cell, size = scan.ring * 360 + azimuth, (int(scan.ring.max()) + 1) * 360
    count = np.bincount(cell, minlength=size)
    total = np.bincount(cell, np.linalg.norm(scan.points, axis=1), minlength=size)
    image = np.full(256 * 360, np.nan)
    image[:size][count > 0] = total[count > 0] / count[count > 0]
    return image
