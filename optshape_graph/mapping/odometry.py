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


class OdometryTrack:
    """Poses over time, asked for in order of time, and forgotten when they have passed.

    Args:
        poses: T_odometry_body (4, 4) in order of time.
        T_body_lidar: (4, 4) of the LiDAR on the body; None: they are one.
        noise: of the motion between poses.

    Attributes:
        T_body_lidar: (4, 4) of the LiDAR on the body that the poses are of.
        noise: of the motion between poses.
        span: seconds, of the first and the last pose read; None before there is one.
    """

    def __init__(
        self, poses: Iterable[Stamped[Floats]], T_body_lidar: PoseLike | None = None, noise: MotionNoise = DRIFT
    ) -> None:
        self.noise = noise
        self.T_body_lidar = np.eye(4) if T_body_lidar is None else as_transform(T_body_lidar, "T_body_lidar")
        self.span: tuple[float, float] | None = None
        self._poses = iter(poses)
        self._window: list[Stamped[Floats]] = []
        self._misfit = np.zeros(2)
        self._freedom = 0

    def sweep(self, stamp: float, start: float = 0.0, end: float = 0.0) -> Sweep | None:
        """Return the LiDAR's motion about a scan; None where no poses are around its stamp.

        It is fitted to the poses during the scan and the one before and after.

        Args:
            stamp: seconds.
            start: of the scan, seconds from the stamp.
            end: of the scan.
        """
        first, last = stamp + min(start, 0.0), stamp + max(end, 0.0)
        while len(self._window) < 2 or self._window[-1].stamp <= last:
            following = next(self._poses, None)
            if following is None:
                break
            self.span = (following.stamp if self.span is None else self.span[0], following.stamp)
            self._window.append(following)
            while len(self._window) > 2 and self._window[1].stamp <= first:
                del self._window[0]
        if not self._window or not self._window[0].stamp <= stamp <= self._window[-1].stamp:
            return None
        stamps = np.array([pose.stamp for pose in self._window])
        begin = max(int(np.searchsorted(stamps, first, "right")) - 1, 0)
        after = min(int(np.searchsorted(stamps, last, "left")) + 1, len(stamps))
        used = self._window[begin : max(after, begin + 2)]
        found = Sweep.fit([pose.stamp - stamp for pose in used], [pose.value @ self.T_body_lidar for pose in used])
        self._misfit += found.misfit
        self._freedom += found.freedom
        rotation, translation = np.sqrt(self._misfit / max(3 * self._freedom, 1))
        return replace(found, jitter=(float(rotation), float(translation)), drift=self.noise)
