"""Detections in many scan files, as tasks of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from optshape_graph.detection.detect import Search, detect_in_scans
from optshape_graph.detection.results import Detections
from optshape_graph.errors import InputError
from optshape_graph.io.clouds import read_scans
from optshape_graph.io.records import to_record
from optshape_graph.runs.files import UNREADABLE, Outcome
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target


@dataclass(frozen=True)
class DetectFiles:
    """Reads full scans and finds the targets in them: a function of the paths, for `run_files`.

    Attributes:
        targets: to look for.
        sensor: that made the scans; None: unknown.
        columns: names of the columns, in order, for clouds without names; None: the clouds have names.
        then: draws path, scan and detections, and returns the paths of the pictures; None: nothing is drawn.
    """

    targets: tuple[Target, ...]
    sensor: SensorModel | None = None
    columns: tuple[str, ...] | None = None
    then: Callable[[str, Scan, Detections], Sequence[Path]] | None = None

    AT_ONCE: ClassVar[int] = 8
    """Scans that are searched at once: more gain little, and each holds a whole revolution."""

    def __call__(self, paths: Sequence[str]) -> list[Outcome]:
        scans, errors = read_scans(paths, self.sensor, self.columns)
        found = {k: self._unreadable(paths[k], error) for k, error in errors.items()}
        searched = detect_in_scans([Search(scan, self.targets) for scan in scans.values()])
        for (k, scan), detections in zip(scans.items(), searched, strict=True):
            found[k] = self._outcome(paths[k], scan, detections)
        return [found[k] for k in range(len(paths))]

    def _outcome(self, path: str, scan: Scan, detections: Detections | InputError) -> Outcome:
        if isinstance(detections, InputError):
            return self._unreadable(path, detections)
        pictures = () if self.then is None else tuple(map(str, self.then(path, scan, detections)))
        reasons = tuple(f"{path}: {one.status}: {one.reason}" for one in detections.found if one.reason)
        return Outcome("ambiguous" if reasons else "ok", reasons, detections.to_dict(), pictures)

    def _unreadable(self, path: str, error: InputError) -> Outcome:
        return Outcome(UNREADABLE, (str(error),), self.failed(path, str(error)).entry)

    def failed(self, path: str, reason: str) -> Outcome:
        """Return the outcome of a scan that could not be used.

        Args:
            path: of the scan.
            reason: why.
        """
        entry = {"scan": path, "targets": [], "rejected": [], "error": reason}
        return Outcome("failed", (f"{path}: {reason}",), entry)

    def describe(self) -> dict[str, Any]:
        """Return all settings that decide the results, as plain data."""
        return {
            "targets": [to_record(target) for target in self.targets], "sensor": to_record(self.sensor),
            "columns": self.columns and list(self.columns),
        }  # fmt: skip
