"""Detections in many scan files, as tasks of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from optshape_graph.detection.detect import detect_targets
from optshape_graph.detection.results import Detections
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.clouds import read_scan
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

    AT_ONCE: ClassVar[int] = 1
    """The candidates of one scan are many already."""

    def __call__(self, paths: Sequence[str]) -> list[Outcome]:
        return [self._outcome(path) for path in paths]

    def _outcome(self, path: str) -> Outcome:
        try:
            scan = read_scan(path, self.sensor, self.columns)
            detections = detect_targets(scan, self.targets)
        except (InputError, EstimationError) as error:
            return Outcome(UNREADABLE, (str(error),), self.failed(path, str(error)).entry)
        pictures = () if self.then is None else tuple(map(str, self.then(path, scan, detections)))
        reasons = tuple(f"{path}: {one.status}: {one.reason}" for one in detections.found if one.reason)
        return Outcome("ambiguous" if reasons else "ok", reasons, detections.to_dict(), pictures)

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
