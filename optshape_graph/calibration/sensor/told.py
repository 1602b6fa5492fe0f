"""What the boards told of a sensor, and what they can't: directions of the errors, against their prior."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from optshape_graph.calibration.sensor.graph import Joint
from optshape_graph.calibration.sensor.unknowns import Deviation
from optshape_graph.factors import AZIMUTH, ELEVATION, RANGE_BIAS
from optshape_graph.sensor import SensorModel

TOLD = 0.7
"""Share of its prior standard deviation above which a direction counts as held where the file has it."""

MEAN_RANGE = "mean range bias"
"""Name of the direction in which all rings' ranges are off alike."""

NAMES = {RANGE_BIAS: ("range bias", "m"), ELEVATION: ("elevation", "rad"), AZIMUTH: ("azimuth", "rad")}


@dataclass(frozen=True)
class Direction:
    """A direction of the rings' errors that free boards may leave open.

    Attributes:
        name: what it is.
        unit: of the standard deviations, "m" or "rad".
        sd: standard deviation after the calibration.
        prior_sd: before it.
    """

    name: str
    unit: str
    sd: float
    prior_sd: float

    @property
    def told(self) -> bool:
        """Whether the boards said more of it than the file."""
        return self.sd < TOLD * self.prior_sd


def directions(deviations: Mapping[str, Deviation]) -> tuple[Direction, ...]:
    """Return means of the rings' errors, and their trends with elevation, from the lowest seen ring to the highest.

    Args:
        deviations: of each kind.
    """
    found = []
    for kind, of in deviations.items():
        (what, unit), seen = NAMES[kind], of.seen
        if seen.sum() < 3:
            continue
        fit = np.linalg.pinv(np.column_stack([np.ones(seen.sum()), of.trend[seen] - of.trend[seen].mean()]))
        for name, w in ((f"mean {what}", fit[0]), (f"trend of {what}", np.ptp(of.trend[seen]) * fit[1])):
            sd, prior_sd = (float(np.sqrt(w @ every[np.ix_(seen, seen)] @ w)) for every in (of.covariance, of.prior))
            found.append(Direction(name, unit, sd, prior_sd))
    return tuple(found)


def mean_range_is_told(joint: Joint, sensor: SensorModel) -> bool:
    """Return whether a solution knows the rings' mean range better than the file leaves it open.

    Args:
        joint: the solution.
        sensor: the file that was its prior.
    """
    of = Deviation.of(sensor, RANGE_BIAS, joint.errors, joint.beta, joint.covariance)
    return any(one.name == MEAN_RANGE and one.told for one in directions({RANGE_BIAS: of}))


def silent_rings(deviations: Iterable[Deviation]) -> tuple[int, ...]:
    """Return the rings of which the boards told next to nothing, by the deviations of each kind."""
    held = np.all([of.sd > TOLD * np.sqrt(np.diag(of.prior)) for of in deviations], axis=0)
    return tuple(np.flatnonzero(held).tolist())
