"""What is unknown of a sensor and of the boards that it is calibrated with, in units of prior standard deviations.

Of each ring: how far its range, elevation and azimuth are off the file. Of all edges: how far inside them rings end, in
beam widths. Of each board: how much larger it is than drawn, and how it is bent. And one that keeps edges from telling
what they can't: ring ends have a systematic of about 0.03 of a beam, which all share and no model has; seen at the size
of a board, that is as much as some millimetres of range. So edges get an error of their own that looks exactly like a
range bias common to all rings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.factors import (
    AZIMUTH,
    COMMON_AZIMUTH,
    COMMON_ELEVATION,
    COMMON_RANGE,
    ELEVATION,
    RANGE_BIAS,
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


@dataclass(frozen=True, eq=False, repr=False)
class RingDeviations(Value):
    """How far each ring of a sensor is off its file.

    Attributes:
        range_bias: (R,) metres by which it measures too far.
        elevation: (R,) rad by which it looks higher.
        azimuth: (R,) rad by which it looks farther to the left.
        range_bias_sd: (R,) standard deviation, metres.
        elevation_sd: (R,) rad.
        azimuth_sd: (R,) rad.
    """

    range_bias: Floats
    elevation: Floats
    azimuth: Floats
    range_bias_sd: Floats
    elevation_sd: Floats
    azimuth_sd: Floats

    @classmethod
    def of(cls, sensor: SensorModel, errors: Sequence[SharedError], beta: Floats, sd: Floats) -> RingDeviations:
        """Return the deviations that errors are; those of rings that were not seen are what the file says.

        Args:
            sensor: the file that is calibrated.
            errors: (k,) the unknowns.
            beta: (k,) in prior standard deviations.
            sd: (k,) of them, in prior standard deviations.
        """
        columns = []
        for kind in (RANGE_BIAS, ELEVATION, AZIMUTH):
            prior = prior_sds(sensor, kind)
            mean, left, together = np.zeros(sensor.n_rings), np.ones(sensor.n_rings), 0.0
            for error, value, spread in zip(errors, beta, sd, strict=True):
                if error.kind == kind and error.ring is not None:
                    mean[error.ring], left[error.ring] = value, spread
                elif error.kind == COMMON[kind]:
                    together = value * common_sd(sensor, kind)
            # A range that is measured too far is pulled in by the unknown; angles are raised by it.
            columns.append((mean * prior + together, left * prior))
        (b, sb), (e, se), (a, sa) = columns
        return cls(-b, e, a, sb, se, sa)


COMMON = {RANGE_BIAS: COMMON_RANGE, ELEVATION: COMMON_ELEVATION, AZIMUTH: COMMON_AZIMUTH}
"""What all rings have in common of a kind of error."""


def common_sd(sensor: SensorModel, kind: str) -> float:
    """Return the standard deviation that the sensor's file has for what all rings have in common, metres or rad."""
    return {
        RANGE_BIAS: sensor.common_range_sd,
        ELEVATION: sensor.common_elevation_sd,
        AZIMUTH: sensor.common_azimuth_sd,
    }[kind]


def prior_sds(sensor: SensorModel, kind: str) -> Floats:
    """Return the standard deviations (R,) that the sensor's file has for an error of its rings, metres or rad."""
    return {RANGE_BIAS: sensor.range_bias_sds, ELEVATION: sensor.elevation_sds, AZIMUTH: sensor.azimuth_sds}[kind]
