"""What a calibration to motion capture results in, and the form in which it is written."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from optshape_graph._arrays import Floats, shortened
from optshape_graph.calibration.mocap.comparison import MocapScan, ScanError, mean_error
from optshape_graph.calibration.verdict import Calibration, Finding
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.results import Row
from optshape_graph.se3 import inverse, inverse_covariance
from optshape_graph.target import Target


@dataclass(frozen=True)
class LeftOut:
    """A scan of the session that takes no part.

    Attributes:
        scan: its file, as the session names it.
        reason: why.
    """

    scan: str
    reason: str


@dataclass(frozen=True, eq=False, repr=False)
class MocapCalibration(Calibration):
    """A LiDAR tied to motion capture.

    Attributes:
        T_lidar_mocap: (4, 4).
        covariance: (6, 6) of its right perturbation: rotation first, motion-capture frame. Widened where the scans
            scatter more than they should.
        marker_layout: (n, 3) markers, target frame, metres.
        layout_sigma: (n, 3) their standard deviations, metres.
        scale: of the motion capture: p_lidar = T_lidar_mocap (scale p_mocap). 1 unless asked for, or far from it.
        scale_sigma: its standard deviation; 0 where it was not estimated.
        T_lidar_target: (4, 4) of each scan, from returns and markers together.
        scatter: the scans' mean square disagreement with the solution, 1 where the covariances are right.
        chi_square: of each scan, its squared distance from what the others say of it, in the stated covariances:
            chi-square with 6 degrees of freedom where these are right.
        leave_one_out: errors of each scan's LiDAR estimate, the frames tied by all other scans.
        in_sample: errors with the frames tied by all scans.
        scans: the scans that took part, with their markers as they were used.
        left_out: the scans that did not, and why.
        findings: what is wrong, was mended, or has to be known.
        passed_over: what of the session's files was not used.
    """

    FORM: ClassVar[str] = "mocap"

    T_lidar_mocap: Floats
    covariance: Floats
    marker_layout: Floats
    layout_sigma: Floats
    scale: float
    scale_sigma: float
    T_lidar_target: tuple[Floats, ...]
    scatter: float
    chi_square: tuple[float, ...]
    leave_one_out: tuple[ScanError, ...]
    in_sample: tuple[ScanError, ...]
    scans: tuple[MocapScan, ...]
    left_out: tuple[LeftOut, ...]
    findings: tuple[Finding, ...]
    passed_over: PassedOver = field(default_factory=PassedOver, compare=False)

    @property
    def target(self) -> Target:
        """The target that was seen."""
        return self.scans[0].estimate.target

    @property
    def T_mocap_lidar(self) -> Floats:
        """(4, 4) inverse of T_lidar_mocap."""
        return inverse(self.T_lidar_mocap)

    @property
    def covariance_mocap_lidar(self) -> Floats:
        """(6, 6) of the right perturbation of T_mocap_lidar: rotation first, LiDAR frame."""
        return inverse_covariance(self.T_lidar_mocap, self.covariance)

    def __repr__(self) -> str:
        mean, sd = mean_error(self.leave_one_out), np.sqrt(np.diag(self.covariance))
        said = f"± {1e3 * sd[3:].max():.1f} mm, ± {np.degrees(sd[:3].max()):.2f} deg, {self.verdict}"
        return shortened(f"MocapCalibration({len(self.scans)} scans, RMSE {1e3 * mean.rmse_m:.1f} mm, {said})")

    def rows(self) -> list[Row]:
        """Return a row for each scan: its leave-one-out errors."""
        pairs = zip(self.leave_one_out, self.chi_square, strict=True)
        return [{**_entry(error), "chi_square": chi_square} for error, chi_square in pairs]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form, `schema: optshape/mocap/1`."""
        return {
            "schema": "optshape/mocap/1",
            "protocol": "leave-one-out",
            "verdict": self.verdict,
            "warnings": list(self.warnings),
            "T_lidar_mocap": self.T_lidar_mocap.tolist(),
            "covariance": self.covariance.tolist(),
            "marker_layout": self.marker_layout.tolist(),
            "scans": [
                {**_entry(error), "T_lidar_target": T.tolist(), "chi_square": chi_square}
                for error, T, chi_square in zip(self.leave_one_out, self.T_lidar_target, self.chi_square, strict=True)
            ],
            "mean": _numbers(mean_error(self.leave_one_out)),
            "in_sample": {
                "scans": [_entry(error) for error in self.in_sample],
                "mean": _numbers(mean_error(self.in_sample)),
            },
            "T_mocap_lidar": self.T_mocap_lidar.tolist(),
            "covariance_mocap_lidar": self.covariance_mocap_lidar.tolist(),
            "scale": self.scale,
            "scale_sigma": self.scale_sigma,
            "scatter": self.scatter,
            "left_out": [{"scan": item.scan, "reason": item.reason} for item in self.left_out],
            **self.passed_over.to_dict(),
        }


def _entry(error: ScanError) -> dict[str, Any]:
    return {"scan": error.scan, **_numbers(error)}


def _numbers(error: ScanError) -> dict[str, float]:
    return {"rmse_m": error.rmse_m, "e_t_m": error.e_t_m, "e_r_deg": error.e_r_deg}
