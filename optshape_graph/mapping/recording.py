"""A recording as landmark SLAM sees it: scans become sightings at keyframes, poses become odometry between them."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from optshape_graph.mapping.incremental import LandmarkSlam
from optshape_graph.mapping.keyframes import Keyframe, KeyframePolicy, Progress, keyframes, session_scans
from optshape_graph.mapping.observe import Observed, observe, observe_all
from optshape_graph.mapping.odometry import MotionNoise, OdometryTrack
from optshape_graph.se3 import inverse

__all__ = [
    "Keyframe", "KeyframePolicy", "MotionNoise", "Observed", "OdometryTrack", "Progress", "build_map", "keyframes",
    "observe", "observe_all", "session_scans",
]  # fmt: skip


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
