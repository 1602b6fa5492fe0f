"""What a calibration of a sensor results in, and the form in which it is written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from optshape_graph._arrays import Floats, frozen, shortened
from optshape_graph.calibration.sensor.noise import Sampling
from optshape_graph.calibration.sensor.told import Direction
from optshape_graph.calibration.verdict import Calibration, Finding
from optshape_graph.io.results import Row
from optshape_graph.sensor import SensorModel


@dataclass(frozen=True)
class PlacementResult:
    """A board that stood still.

    Attributes:
        scan: name of the first scan that it was seen in.
        target: name of the board.
        distance: from the sensor, metres.
        revolutions: that took part.
        returns: on it, in all of them.
        gain: logarithm by which it becomes likelier by the calibration of the others; None: it was not left out.
    """

    scan: str
    target: str
    distance: float
    revolutions: int
    returns: int
    gain: float | None


@dataclass(frozen=True, eq=False, repr=False)
class SensorCalibration(Calibration):
    """A sensor, its rings calibrated.

    Attributes:
        sensor: as calibrated: what `save_sensor` writes.
        given: the sensor file that was calibrated.
        placements: the boards.
        directions: what free boards may leave open, and how well it is known now.
        silent: rings of which the boards told next to nothing.
        sampling: how the sensor samples.
        drift: standard deviation of what each placement has of its own in each ring's range bias, metres.
        before: (R,) root mean square, over the placements left out, of how far a ring's returns are behind the board,
            by the given file, metres; NaN for rings that were not on one.
        after: (R,) the same by the calibration of the others, metres.
        left_out: scans that took no part, and why.
        findings: what is wrong, or has to be known.
    """

    FORM: ClassVar[str] = "sensor-calibration"

    sensor: SensorModel
    given: SensorModel
    placements: tuple[PlacementResult, ...]
    directions: tuple[Direction, ...]
    silent: tuple[int, ...]
    sampling: Sampling
    drift: float
    before: Floats
    after: Floats
    left_out: tuple[str, ...]
    findings: tuple[Finding, ...]

    def __post_init__(self) -> None:
        for field in ("before", "after"):
            object.__setattr__(self, field, frozen(getattr(self, field)))

    @property
    def gain(self) -> float:
        """Logarithm by which all placements left out become likelier by the calibration of the others."""
        return float(sum(one.gain for one in self.placements if one.gain is not None))

    @property
    def helps(self) -> bool:
        """Whether placements that took no part become likelier: else the calibration is not to be written."""
        return self.gain > 0

    def __repr__(self) -> str:
        before, after = (1e3 * _rms(values) for values in (self.before, self.after))
        return shortened(
            f"SensorCalibration('{self.sensor.name}', {len(self.placements)} placements, rings {before:.1f} -> "
            f"{after:.1f} mm, {self.verdict})"
        )

    def rows(self) -> list[Row]:
        """Return a row for each ring: how far it is off the given file, and the standard deviations."""
        sensor, given = self.sensor, self.given
        bias, elevation, azimuth = (now - then for now, then in zip(_totals(sensor), _totals(given), strict=True))
        return [
            {
                "ring": k,
                "elevation_deg": float(np.degrees(sensor.elevations[k])),
                "range_bias_mm": 1e3 * float(bias[k]),
                "range_bias_sd_mm": 1e3 * float(sensor.range_bias_sds[k]),
                "elevation_off_deg": float(np.degrees(elevation[k])),
                "elevation_sd_deg": float(np.degrees(sensor.elevation_sds[k])),
                "azimuth_off_deg": float(np.degrees(azimuth[k])),
                "azimuth_sd_deg": float(np.degrees(sensor.azimuth_sds[k])),
                "before_mm": _number(1e3 * self.before[k]),
                "after_mm": _number(1e3 * self.after[k]),
            }
            for k in range(sensor.n_rings)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form, `schema: optshape/sensor-calibration/1`."""
        sampling = self.sampling
        return {
            "schema": f"optshape/{self.FORM}/1",
            "sensor": self.sensor.name,
            "verdict": self.verdict,
            "warnings": list(self.warnings),
            "gain": self.gain,
            "helps": self.helps,
            "rings": self.rows(),
            "edge_offset": self.sensor.edge_offset,
            "edge_offset_sd": self.sensor.edge_offset_sd,
            "range_noise_m": sampling.range_noise,
            "range_noise_sd_m": sampling.range_noise_sd,
            "smooth_noise_m": sampling.smooth_noise,
            "range_drift_m": self.drift,
            "azimuth_step_deg": float(np.degrees(sampling.azimuth_step)),
            "azimuth_step_sd_deg": float(np.degrees(sampling.azimuth_step_sd)),
            "directions": [
                {"name": one.name, "unit": one.unit, "sd": one.sd, "prior_sd": one.prior_sd, "told": one.told}
                for one in self.directions
            ],
            "silent_rings": list(self.silent),
            "placements": [
                {
                    "scan": one.scan, "target": one.target, "distance_m": one.distance, "revolutions": one.revolutions,
                    "returns": one.returns, "gain": one.gain,
                }
                for one in self.placements
            ],
            "left_out": list(self.left_out),
        }  # fmt: skip


def _totals(sensor: SensorModel) -> tuple[Floats, Floats, Floats]:
    """Range bias, elevation and azimuth offset (R,) of each ring, metres and rad."""
    nothing = np.zeros(sensor.n_rings)
    bias = nothing if sensor.range_bias is None else sensor.range_bias
    return bias, sensor.elevations, nothing if sensor.azimuth_offsets is None else sensor.azimuth_offsets


def _rms(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
