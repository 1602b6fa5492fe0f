"""Estimates of many scan files, as tasks of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.clouds import read_scan
from optshape_graph.io.records import to_record
from optshape_graph.pose import Backend, Method, PoseEstimate, estimate_pose
from optshape_graph.runs.files import UNREADABLE, Outcome
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target


@dataclass(frozen=True)
class EstimateFile:
    """Reads a scan and estimates its target's pose: a function of the path, for `run_files`.

    Attributes:
        target: the template.
        sensor: that made the scans; None: unknown.
        method: of `estimate_pose`.
        backend: of `estimate_pose`.
        columns: names of the clouds' columns that have none, in order; None: they name their own.
        then: called with path, scan and estimate, to draw them, and returns the pictures; None: nothing is drawn.
    """

    target: Target
    sensor: SensorModel | None = None
    method: Method = "global"
    backend: Backend = "closed-form"
    columns: tuple[str, ...] | None = None
    then: Callable[[str, Scan, PoseEstimate], Sequence[Path]] | None = None

    def __call__(self, path: str) -> Outcome:
        try:
            scan = read_scan(path, self.sensor, self.columns)
            estimate = estimate_pose(scan, self.target, self.method, self.backend)
        except InputError as error:
            return Outcome(UNREADABLE, (str(error),), PoseEstimate.failed_entry(path, self.target.name, str(error)))
        except EstimationError as error:
            return self.failed(path, str(error))
        pictures = () if self.then is None else tuple(map(str, self.then(path, scan, estimate)))
        reasons = (f"{path}: {estimate.status}: {estimate.reason}",) if estimate.status != "ok" else ()
        return Outcome(estimate.status, reasons, estimate.to_dict(), pictures)

    def failed(self, path: str, reason: str) -> Outcome:
        """Return the outcome of a scan that gave no estimate.

        Args:
            path: of the scan.
            reason: why.
        """
        return Outcome("failed", (f"{path}: {reason}",), PoseEstimate.failed_entry(path, self.target.name, reason))

    def describe(self) -> dict[str, Any]:
        """Return what decides the results, as plain data."""
        return {
            "target": to_record(self.target), "sensor": to_record(self.sensor), "method": self.method,
            "backend": self.backend, "columns": self.columns and list(self.columns),
        }  # fmt: skip
