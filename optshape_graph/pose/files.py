"""Estimates of many scan files, as tasks of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.clouds import read_scans
from optshape_graph.io.records import to_record
from optshape_graph.pose import Backend, Method, PoseEstimate, estimate_poses
from optshape_graph.runs.files import UNREADABLE, Outcome
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target


@dataclass(frozen=True)
class EstimateFiles:
    """Reads scans and estimates their target's poses, of all at once: a function of the paths, for `run_files`.

    Attributes:
        target: the template.
        sensor: that made the scans; None: unknown.
        method: of `estimate_poses`.
        backend: of `estimate_poses`.
        columns: names of the clouds' columns that have none, in order; None: they name their own.
        then: called with path, scan and estimate, to draw them, and returns the pictures; None: nothing is drawn.
    """

    target: Target
    sensor: SensorModel | None = None
    method: Method = "global"
    backend: Backend = "closed-form"
    columns: tuple[str, ...] | None = None
    then: Callable[[str, Scan, PoseEstimate], Sequence[Path]] | None = None

    AT_ONCE: ClassVar[int] = 16
    """Scans whose poses are estimated at once: more gain little, and wait for each other."""

    def __call__(self, paths: Sequence[str]) -> list[Outcome]:
        scans, errors = read_scans(paths, self.sensor, self.columns)
        found = {k: self._unreadable(paths[k], error) for k, error in errors.items()}
        estimates = estimate_poses(list(scans.values()), self.target, self.method, self.backend)
        for (k, scan), estimate in zip(scans.items(), estimates, strict=True):
            found[k] = self._outcome(paths[k], scan, estimate)
        return [found[k] for k in range(len(paths))]

    def _outcome(self, path: str, scan: Scan, estimate: PoseEstimate | EstimationError) -> Outcome:
        if isinstance(estimate, EstimationError):
            return self.failed(path, str(estimate))
        pictures = () if self.then is None else tuple(map(str, self.then(path, scan, estimate)))
        reasons = (f"{path}: {estimate.status}: {estimate.reason}",) if estimate.status != "ok" else ()
        return Outcome(estimate.status, reasons, estimate.to_dict(), pictures)

    def _unreadable(self, path: str, error: InputError) -> Outcome:
        entry = PoseEstimate.failed_entry(path, self.target.name, str(error))
        return Outcome(UNREADABLE, (str(error),), entry)

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
