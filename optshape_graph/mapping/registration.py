"""Motion of a LiDAR from its scans alone, by KISS-ICP (Vizzo et al., IEEE RA-L 2023): odometry where there is none.

Needs the extra `icp`. Without the library, scans still tell whether the LiDAR moved.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain, islice, pairwise

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import missing_extra
from optshape_graph.io.recordings.stream import Stamped
from optshape_graph.mapping.sweep import MotionNoise, Sweep
from optshape_graph.scan import Scan
from optshape_graph.se3 import exp, log

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

UNKNOWN = 0.5, 1.0
"""Motion of a LiDAR of which is known that it moves: standard deviations, rad/s and m/s."""


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
    usable = ((item.stamp, item.value) for item in scans if item.value.time is not None and len(item.value))
    beginning = list(islice(usable, LOOKED_AT))
    if not beginning:
        return
    config = KISSConfig()
    reach = float(np.percentile(np.linalg.norm(beginning[0][1].points, axis=1), 95))
    config.data.max_range, config.data.min_range, config.mapping.voxel_size = 1.5 * reach, 0.3, reach / VOXELS

    def register(odometry: KissICP, scan: Scan) -> Floats:
        times = _times(scan)
        start, end = float(times.min()), float(times.max())
        odometry.register_frame(np.array(scan.points), (times - start) / max(end - start, 1e-9))
        return np.array(odometry.last_pose)

    # It takes the LiDAR to be at rest at first: the beginning is registered twice, the second time as moving on.
    trial, odometry = KissICP(config), KissICP(config)
    for _, scan in beginning:
        register(trial, scan)
    odometry.last_delta = trial.last_delta
    stamp, scan = beginning[0]
    pose = register(odometry, scan)
    start, end = stamp + float(_times(scan).min()), stamp + float(_times(scan).max())
    yield Stamped(start, pose @ exp(-log(np.array(trial.last_delta))))
    yield Stamped(end, pose)
    for stamp, scan in chain(beginning[1:], usable):
        yield Stamped(stamp + float(_times(scan).max()), register(odometry, scan))


def _times(scan: Scan) -> Floats:
    assert scan.time is not None  # others were left out
    return scan.time


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


def unknown_motion(n_scans: int) -> Sweep:
    """Return the motion within each of some scans of a LiDAR of which is known that it moves, and nothing else.

    It is much the same in all of them and doesn't average away: each is taken to be less known, so that together they
    are as well known as one.
    """
    rotation, translation = (float(np.sqrt(max(n_scans, 1))) * sigma for sigma in UNKNOWN)
    return Sweep(np.eye(4), np.zeros((2, 6)), np.diag([0.0, 1.0]), jitter=(rotation, translation))


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
