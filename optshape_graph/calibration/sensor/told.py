"""What the boards told of a sensor, and what they can't: directions of the errors, against their prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.sensor.graph import Joint
from optshape_graph.calibration.sensor.unknowns import COMMON, common_sd, prior_sds
from optshape_graph.factors import AZIMUTH, ELEVATION, RANGE_BIAS
from optshape_graph.sensor import SensorModel

TOLD = 0.7
"""Share of its prior standard deviation above which a direction counts as held where the file has it."""

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


def directions(joint: Joint, sensor: SensorModel) -> tuple[Direction, ...]:
    """Return means of the rings' errors, and their trends with elevation, from the lowest seen ring to the highest."""
    found = []
    for kind, (what, unit) in NAMES.items():
        index = np.array([i for i, error in enumerate(joint.errors) if error.kind == kind], int)
        rings = np.array([joint.errors[i].ring for i in index], int)
        if len(rings) < 3:
            continue
        prior = prior_sds(sensor, kind)[rings]
        elevation = sensor.elevations[rings]
        slope = (elevation - elevation.mean()) / ((elevation - elevation.mean()) ** 2).sum() * np.ptp(elevation)
        for name, weight in ((f"mean {what}", np.full(len(rings), 1 / len(rings))), (f"trend of {what}", slope)):
            w = weight * prior
            sd = float(np.sqrt(w @ joint.covariance[np.ix_(index, index)] @ w))
            found.append(Direction(name, unit, sd, float(np.linalg.norm(w))))
    return tuple(found)


def in_common(joint: Joint, sensor: SensorModel, kind: str) -> float:
    """Return the standard deviation of what the errors of all seen rings are off by together, metres or rad.

    Args:
        joint: the solution.
        sensor: the file that was calibrated.
        kind: of error.
    """
    index = np.array([i for i, error in enumerate(joint.errors) if error.kind in (kind, COMMON[kind])], int)
    rings = [joint.errors[i].ring for i in index]
    seen = [ring for ring in rings if ring is not None]
    if not seen:
        return 0.0
    prior = prior_sds(sensor, kind)
    weight = np.array([common_sd(sensor, kind) if ring is None else prior[ring] / len(seen) for ring in rings])
    return float(np.sqrt(weight @ joint.covariance[np.ix_(index, index)] @ weight))


def silent_rings(sensor: SensorModel, kinds: Sequence[tuple[Floats, Floats]]) -> tuple[int, ...]:
    """Return the rings of which the boards told next to nothing.

    Args:
        sensor: the file that was calibrated.
        kinds: standard deviations (R,) after and before, of each kind of error.
    """
    held = np.all([after > TOLD * before for after, before in kinds], axis=0)
    assert len(held) == sensor.n_rings
    return tuple(np.flatnonzero(held).tolist())
