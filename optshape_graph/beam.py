"""The width of a beam, and how a ring ends at an edge because of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.sensor import SensorModel


@dataclass(frozen=True)
class Beam:
    """The width of a beam, and how ring ends scatter about an edge because of it.

    A return near an edge comes from part of the beam. How large a part suffices depends on reflectance and threshold,
    so the edge seems to lie further out or further in. The offset across the edge has a part that is common to a scan
    and a part of each point's own; each is uniform over at most the beam's width.

    Attributes:
        divergence: full angle, rad.
        aperture: width where it leaves the sensor, metres.
        blooming: standard deviation of the azimuth by which a scan's rings reach further on each side, rad.
        offset: mean of the offset that all edge points of a scan share, in beam widths.
        common: standard deviation of that offset, in beam widths.
    """

    divergence: float
    aperture: float
    offset: float = SensorModel.edge_offset
    common: float = SensorModel.edge_offset_sd
    blooming: float = 0.0

    OWN: ClassVar[float] = 1 / np.sqrt(12)
    """Standard deviation of each edge point's own offset, in beam widths."""

    @classmethod
    def of(cls, sensor: SensorModel | None) -> Beam:
        """Return the beam of a sensor; that of an unknown one diverges by 3 mrad and leaves it a centimetre wide."""
        if sensor is None:
            return cls(3e-3, 0.01)
        return cls(
            sensor.beam_divergence, sensor.beam_aperture, sensor.edge_offset, sensor.edge_offset_sd, sensor.blooming
        )

    @property
    def ideal(self) -> bool:
        """Whether the beam has no width, so that it ends where the target does."""
        return self.divergence + self.aperture == 0

    def width(self, ranges: Floats) -> Floats:
        """Return the width of the beam at ranges (...), metres; that of an ideal beam is a tenth of a millimetre."""
        return np.maximum(self.aperture + self.divergence * ranges, 1e-4)

    def offset_of_rays(self, ranges: Floats) -> float:
        """Return the standard deviation of the offset across all edges with blooming included, in beam widths.

        Args:
            ranges: (N,) metres.
        """
        return float(np.hypot(self.common, self.blooming / np.mean(self.width(ranges) / ranges)))


FINEST_STEP = 0.2
"""Smallest step across an edge, in beam widths, that counts. With a smaller one a ring runs along the edge, and ends at
a vertex, not where rays happen to return."""


def outermost_return(step: Floats) -> tuple[Floats, Floats]:
    """Return where a ring's last return lies about an edge, and its scatter, if several rays are within a beam's width.

    It is the outermost of the rays that returned: further out than a single ray would be, with less scatter.

    Args:
        step: (...) how far across the edge the ring's next ray is, in beam widths.

    Returns:
        How much further out it lies, in beam widths, and its scatter over that of a single ray, each (...).
    """
    steps, shift, share = outermost_table()
    step = np.maximum(step, FINEST_STEP)
    return np.interp(step, steps, shift), np.interp(step, steps, share)


@cache
def outermost_table() -> tuple[Floats, Floats, Floats]:
    """Return the table of `outermost_return`, in its units: steps, how much further out, and scatter, each (8,).

    Rays a step apart, in any phase, each return with a probability that falls from 1 to 0 over the beam's width. The
    shift and the scatter by the phase itself are subtracted.
    """
    steps, phase = np.geomspace(FINEST_STEP, 1.0, 8), (np.arange(16) + 0.5) / 16
    x = np.linspace(-1.5, 0.5, 401)
    table = []
    for step in steps:
        place = step * (phase[:, None] + np.arange(-np.ceil(1.5 / step), np.ceil(0.5 / step) + 1))
        returns = np.clip(0.5 - place, 0.0, 1.0)
        # The outermost lies before x where no ray beyond x returns.
        before = np.where(place > x[:, None, None], 1.0 - returns, 1.0).prod(axis=2).mean(axis=1)
        middle, mass = 0.5 * (x[1:] + x[:-1]), np.diff(before)
        mean = mass @ middle / mass.sum()
        variance = mass @ middle**2 / mass.sum() - mean**2
        table.append((mean + step / 2, np.sqrt(12.0 * max(variance - step**2 / 12.0, 0.0))))
    shift, share = np.array(table).T
    return steps, np.maximum(shift, 0.0), np.minimum(share, 1.0)
