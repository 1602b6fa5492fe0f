"""Odometry: poses over time, as they come, and the noise of the motion between them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.io.recordings.stream import Stamped
from optshape_graph.mapping.sweep import MotionNoise, Sweep
from optshape_graph.se3 import PoseLike, as_transform

DRIFT = MotionNoise()
"""Of odometry of which nothing else is known."""

KEPT = 0.5
"""Seconds of poses that are kept before a scan begins: another LiDAR's next scan may have begun earlier."""

GAP, GAP_IN_STEPS = 1.0, 5.0
"""A motion is not interpolated over so many seconds that are so many of the least step between poses, too."""


class OdometryTrack:
    """Poses over time, asked for in order of time, and forgotten when they have passed.

    Args:
        poses: T_odometry_body (4, 4) in order of time.
        T_body_lidar: (4, 4) of the LiDAR on the body, of several the first one; None: they are one.
        noise: of the motion between poses.
        clock_sd: standard deviation of the stamps of all of them against those of the scans, seconds.

    Attributes:
        T_body_lidar: (4, 4) of the LiDAR on the body that the poses are of.
        noise: of the motion between poses.
        clock_sd: standard deviation of the stamps of all of them against those of the scans, seconds.
        span: seconds, of the first and the last pose read; None before there is one.
    """

    def __init__(
        self,
        poses: Iterable[Stamped[Floats]],
        T_body_lidar: PoseLike | None = None,
        noise: MotionNoise = DRIFT,
        clock_sd: float = 0.0,
    ) -> None:
        self.noise = noise
        self.clock_sd = clock_sd
        self.T_body_lidar = np.eye(4) if T_body_lidar is None else as_transform(T_body_lidar, "T_body_lidar")
        self.span: tuple[float, float] | None = None
        self._poses = iter(poses)
        self._window: list[Stamped[Floats]] = []
        self._misfit = np.zeros(2)
        self._freedom = 0

    def sweep(
        self, stamp: float, start: float = 0.0, end: float = 0.0, T_lidar_other: Floats | None = None
    ) -> Sweep | None:
        """Return the LiDAR's motion about a scan; None where no poses are around its stamp.

        It is fitted to the poses during the scan and the one before and after.

        Args:
            stamp: seconds.
            start: of the scan, seconds from the stamp.
            end: of the scan.
            T_lidar_other: (4, 4) of another LiDAR of the robot, whose motion is asked for; None: of the first.
        """
        first, last = stamp + min(start, 0.0), stamp + max(end, 0.0)
        while len(self._window) < 2 or self._window[-1].stamp <= last:
            following = next(self._poses, None)
            if following is None:
                break
            self.span = (following.stamp if self.span is None else self.span[0], following.stamp)
            self._window.append(following)
            while len(self._window) > 2 and self._window[1].stamp <= first - KEPT:
                del self._window[0]
        if not self._window or not self._window[0].stamp <= stamp <= self._window[-1].stamp:
            return None
        stamps = np.array([pose.stamp for pose in self._window])
        begin = max(int(np.searchsorted(stamps, first, "right")) - 1, 0)
        after = min(int(np.searchsorted(stamps, last, "left")) + 1, len(stamps))
        used = self._window[begin : max(after, begin + 2)]
        steps = np.diff([pose.stamp for pose in used])
        if steps.max() > GAP and steps.max() > GAP_IN_STEPS * np.diff(stamps).min():
            return None
        T = self.T_body_lidar if T_lidar_other is None else self.T_body_lidar @ T_lidar_other
        found = Sweep.fit([pose.stamp - stamp for pose in used], [pose.value @ T for pose in used])
        self._misfit += found.misfit
        self._freedom += found.freedom
        rotation, translation = np.sqrt(self._misfit / max(3 * self._freedom, 1))
        return replace(found, jitter=(float(rotation), float(translation)), drift=self.noise, clock_sd=self.clock_sd)
