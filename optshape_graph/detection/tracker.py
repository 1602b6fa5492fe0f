"""Targets in successive scans, as a sensor delivers them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optshape_graph._arrays import Ints
from optshape_graph.detection.candidates import Size
from optshape_graph.detection.detect import detect_targets
from optshape_graph.detection.options import DetectionOptions
from optshape_graph.detection.results import Detection, Detections
from optshape_graph.errors import InputError
from optshape_graph.scan import Scan
from optshape_graph.target import Target

REVOLUTION_S = 0.1
"""Time between scans without stamps, seconds."""

_DEFAULTS = DetectionOptions()

SURROUNDINGS = 2.0
"""Returns within so many diameters of a target are used: those beside it show whether it hangs free."""


class TargetTracker:
    """Finds targets in successive scans: near their last places, and from time to time everywhere.

    The first scan is searched whole, and so is one in every `everywhere_every` scans, and any scan in which a target is
    not found again. Others are searched only where the targets of the scan before may be by now. `detect_targets`
    searches. Scans are independent: no pose is smoothed.

    Args:
        targets: one target or several to look for.
        options: the settings of detection.
        everywhere_every: one in so many scans is searched whole, so that new targets are found.
        speed: largest speed of a target in the sensor's frame, m/s.
        turn_rate: largest rate of turn of the sensor, rad/s.

    Raises:
        InputError: a limit that is not positive; and as `detect_targets`.
    """

    def __init__(
        self,
        targets: Target | Sequence[Target],
        options: DetectionOptions = _DEFAULTS,
        *,
        everywhere_every: int = 10,
        speed: float = 3.0,
        turn_rate: float = 1.5,
    ) -> None:
        if everywhere_every < 1 or not (speed >= 0 and turn_rate >= 0):
            raise InputError(
                f"tracker: one of {everywhere_every} scans, {speed} m/s, {turn_rate} rad/s; expected at least 1, and "
                "limits >= 0"
            )
        self.targets, self.options = targets, options
        self.everywhere_every, self.speed, self.turn_rate = everywhere_every, speed, turn_rate
        self._found: tuple[Detection, ...] = ()
        self._stamp: float | None = None
        self._since = 0

    def find(self, scan: Scan, stamp: float | None = None) -> Detections:
        """Return the targets of the next scan.

        Args:
            scan: a full revolution, with rings.
            stamp: its time, seconds; None: a tenth of a second after the scan before.

        Raises:
            InputError: a stamp that is not after that of the scan before; and as `detect_targets`.
        """
        passed = REVOLUTION_S if stamp is None or self._stamp is None else stamp - self._stamp
        if passed <= 0:
            raise InputError(f"{scan.name}: stamp {stamp} is not after {self._stamp}, that of the scan before")
        found = self._about(scan, passed) if self._found and self._since + 1 < self.everywhere_every else None
        if found is None or not self._again(found):
            found, self._since = detect_targets(scan, self.targets, self.options), 0
        else:
            self._since += 1
        self._found, self._stamp = found.found, stamp
        return found

    def _about(self, scan: Scan, passed: float) -> Detections | None:
        """Return the detections where targets may be after `passed` seconds; None: they may be anywhere."""
        near = np.zeros(len(scan), dtype=bool)
        ranges = np.sqrt(np.einsum("ni,ni->n", scan.points, scan.points))
        for one in self._found:
            centre = one.estimate.T_lidar_target[:3, 3]
            away = float(np.linalg.norm(centre))
            reach = SURROUNDINGS * Size.of(one.target).diameter + self.speed * passed
            if reach >= away:
                return None
            half = min(float(np.arcsin(reach / away)) + self.turn_rate * passed, np.pi)
            near |= scan.points @ centre >= np.cos(half) * away * ranges
        rows: Ints = np.flatnonzero(near)
        if not len(rows):
            return None
        found = detect_targets(scan.select(rows), self.targets, self.options)
        return replace(found, found=tuple(replace(one, indices=rows[one.indices]) for one in found.found))

    def _again(self, found: Detections) -> bool:
        """Return whether every target of the scan before was found again."""
        before, now = ([one.target.name for one in some] for some in (self._found, found.found))
        return sorted(before) == sorted(now)
