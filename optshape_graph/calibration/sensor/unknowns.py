"""What is unknown of a sensor and of the boards that it is calibrated with, in units of prior standard deviations.

Of each ring: how far its range, elevation and azimuth are off the file. Of all edges: how far inside them rings end, in
beam widths. Of each board: how much larger it is than drawn, and how it is bent. And one that keeps edges from telling
what they can't: ring ends have a systematic of about 0.03 of a beam, which all share and no model has; seen at the size
of a board, that is as much as some millimetres of range. So edges get an error of their own that looks exactly like a
range bias common to all rings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Bools, Floats, Value
from optshape_graph.factors import (
    AZIMUTH,
    AZIMUTH_TREND,
    COMMON_AZIMUTH,
    COMMON_ELEVATION,
    COMMON_RANGE,
    ELEVATION,
    ELEVATION_TREND,
    RANGE_BIAS,
    RANGE_TREND,
    SharedError,
)
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

SIZE, BOW, EDGES_AT_RANGE, DRIFT = "size", "bow", "edges at range", "drift of range"
"""Kinds of errors beside those of the sensor's file; the last is of a ring, but each placement's own."""

SIZE_SD = 1e-3
"""Standard deviation of a board's radius against its drawing, metres."""

BOW_SD = 2e-3
"""Standard deviation of how far a board's rim is bent off its plane, metres, in each of three shapes."""

RANGE_BY_EDGES_SD = 0.01
"""Range bias, metres, that the systematic of ring ends may look like: 0.03 of a beam at an edge half a metre from a
board's middle, five metres away."""

PASSES = 10
"""In which a covariance is taken apart; each leaves a few parts in the number of rings of what the last one left."""

MOSTLY = 2 / 3
"""Share of a sensor's rings that were seen, above which what they share is stated as a trend of all."""

EDGE_SYSTEMATIC = 0.03
"""Standard deviation of what the ends of rings have in common that no model has, in beam widths."""


def board_errors(target: Target) -> tuple[SharedError, ...]:
    """Return what is unknown of a board: its size, then three ways of being bent."""
    return tuple(SharedError(f"{kind} of {target.name}") for kind in (SIZE, *(f"{BOW} {k}" for k in "123")))


def bow(target: Target, yz: Floats) -> Floats:
    """Return by how much a standard deviation of each bow lifts places of a board off its plane, metres, (..., 3).

    Args:
        target: the board.
        yz: (..., 2) places, metres.
    """
    y, z = np.moveaxis(yz / target.circumradius, -1, 0)
    return BOW_SD * np.stack([y * y, z * z, 2 * y * z], axis=-1)


COMMON = {RANGE_BIAS: COMMON_RANGE, ELEVATION: COMMON_ELEVATION, AZIMUTH: COMMON_AZIMUTH}
"""What all rings have in common of a kind of error."""

TREND = {RANGE_BIAS: RANGE_TREND, ELEVATION: ELEVATION_TREND, AZIMUTH: AZIMUTH_TREND}
"""What grows from ring to ring with the elevation."""


def kind_of(error: SharedError) -> str:
    """Return the kind of rings' errors that an error is part of; of another, its own kind."""
    return next((kind for kind in COMMON if error.kind in (COMMON[kind], TREND[kind])), error.kind)


@dataclass(frozen=True, eq=False, repr=False)
class Deviation(Value):
    """How far each ring of a sensor is off its file, in range (metres, too far) or in an angle (rad, up or left).

    Attributes:
        mean: (R,) metres or rad.
        covariance: (R, R) of it, metres or rad squared; of rings that were not seen, what the file says.
        prior: (R, R) by the file, metres or rad squared.
        seen: (R,) whether a ring was.
        trend: (R,) what a trend of one adds to each ring, rad.
    """

    mean: Floats
    covariance: Floats
    prior: Floats
    seen: Bools
    trend: Floats

    @classmethod
    def of(
        cls, sensor: SensorModel, kind: str, errors: Sequence[SharedError], beta: Floats, covariance: Floats
    ) -> Deviation:
        """Return the deviation that errors add up to.

        Args:
            sensor: the file that is calibrated.
            kind: of a ring's errors.
            errors: (k,) the unknowns.
            beta: (k,) in prior standard deviations.
            covariance: (k, k) of them, in those standard deviations squared.
        """
        own, common, trend = prior_sds(sensor, kind)
        moved, seen = np.zeros((sensor.n_rings, len(errors))), np.zeros(sensor.n_rings, dtype=bool)
        for k, error in enumerate(errors):
            if error.kind == kind and error.ring is not None:
                moved[error.ring, k], seen[error.ring] = own[error.ring], True
            elif error.kind == COMMON[kind]:
                moved[:, k] = common
            elif error.kind == TREND[kind]:
                moved[:, k] = trend * sensor.trend
        unseen = np.diag(np.where(seen, 0.0, own) ** 2)
        # A range that is measured too far is pulled in by the unknown; angles are raised by it.
        sign = -1.0 if kind == RANGE_BIAS else 1.0
        return cls(
            sign * moved @ beta, moved @ covariance @ moved.T + unseen, moved @ moved.T + unseen, seen, sensor.trend
        )

    @property
    def sd(self) -> Floats:
        """(R,) standard deviation of each ring's, metres or rad."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def parts(self) -> tuple[Floats, float, float]:
        """The covariance as a file states it: standard deviations of each ring's own error (R,), of one that all rings
        share, and of a trend from ring to ring with the elevation, per rad.

        The shared ones are the mean and the trend of the rings that were seen, each weighed by its variance; less what
        the rings' own errors explain of them. Rings that no board met are not known to follow a trend: it explains no
        more than there is of them, and where they are more than a third of all there is none. A ring's own is no less
        than what would be left of its variance if all other rings were known.
        """
        variance = np.diag(self.covariance)
        jitter = 1e-9 * variance.max() + 1e-30  # errors of rings that are exact have no inverse
        least = 1.0 / np.diag(np.linalg.inv(self.covariance + jitter * np.eye(len(variance))))
        design, lever = np.column_stack([np.ones(len(variance)), self.trend]), np.maximum(self.trend**2, 1e-12)
        root = np.where(self.seen, 1.0 / np.sqrt(variance + jitter), 0.0)
        fit = np.linalg.pinv(design * root[:, None]) * root
        most = np.where(self.seen, np.inf, variance / lever).min() if self.seen.mean() > MOSTLY else 0.0
        of_fit, own = np.diag(fit @ self.covariance @ fit.T), least
        for _ in range(PASSES):
            common, trend = np.maximum(of_fit - fit**2 @ own, 0.0)
            trend = min(trend, most)
            own = np.maximum(variance - common - lever * trend, least)
        return np.sqrt(own), float(np.sqrt(common)), float(np.sqrt(trend))


def prior_sds(sensor: SensorModel, kind: str) -> tuple[Floats, float, float]:
    """Return the standard deviations that a sensor's file has for a kind of its rings' errors, metres or rad.

    Of each ring's own (R,), of what all rings share, and of their trend, per rad.
    """
    return {
        RANGE_BIAS: (sensor.range_bias_sds, sensor.common_range_sd, sensor.range_trend_sd),
        ELEVATION: (sensor.elevation_sds, sensor.common_elevation_sd, sensor.elevation_trend_sd),
        AZIMUTH: (sensor.azimuth_sds, sensor.common_azimuth_sd, sensor.azimuth_trend_sd),
    }[kind]


def with_mean_range_open(sensor: SensorModel) -> SensorModel:
    """Return a sensor's file that leaves open what all rings' ranges have in common: as much as each ring's own.

    Rings' own errors alone, one independent of the other, would say their mean to a sixth of that.

    Args:
        sensor: as its file has it.
    """
    return replace(sensor, common_range_sd=max(sensor.common_range_sd, float(np.median(sensor.range_bias_sds))))
