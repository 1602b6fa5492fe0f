"""Which built-in sensor made a cloud: told by the elevations of its returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.io.sensors import builtin_sensors, load_sensor
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel

FEWEST_RINGS = 4
"""Rings that tell a table."""

CHANCE = 0.25
"""Share of the misfit that elevations which have nothing to do with a table have: below it, the table fits."""

CLEAR = 2.0
"""By this factor the next table fits worse, or the guess is none."""

SMALLEST = np.radians(0.005)
"""Misfits below this are alike: coordinates are rounded, rad."""

FARTHEST_OFF = np.radians(0.5)
"""A table that is no nearer says nothing about the sensor, rad."""

OCCUPIED = 0.9
"""Share of the rows between the lowest and the highest that returns of a cloud without rings must be in."""


@dataclass(frozen=True)
class Guess:
    """What the elevations say.

    Attributes:
        sensor: the built-in one whose table fits; None: none does, or several do.
        misfits: degrees, root mean square, by the names of the tables that come into question, the best first.
    """

    sensor: SensorModel | None
    misfits: dict[str, float]

    def __str__(self) -> str:
        """Say it in a few words."""
        if self.sensor is not None:
            return f"{self.sensor.name} (elevations within {next(iter(self.misfits.values())):.3f} deg of its table)"
        if not self.misfits:
            return "none of the built-in tables is near"
        near = ", ".join(f"{name} ({misfit:.2f} deg)" for name, misfit in list(self.misfits.items())[:3])
        return f"no built-in table fits beyond doubt; near are {near}: the maker's file of the unit has its own"


def guess_sensor(scan: Scan) -> Guess:
    """Compare a cloud's elevations with all built-in tables.

    Args:
        scan: with rings, or of a sensor with rings that the cloud does not name; read without a sensor.
    """
    elevation = np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1]))
    found: list[tuple[float, bool, str]] = []
    for sensor in builtin_sensors():
        misfit = _of_rings(scan.ring, elevation, sensor) if scan.ring is not None else _of_elevations(elevation, sensor)
        if misfit is not None and misfit <= FARTHEST_OFF:
            gap = float(np.median(np.diff(sensor.elevations)))
            found.append((misfit, misfit <= CHANCE * gap / np.sqrt(12), sensor.name))
    found.sort()
    misfits = {name: float(np.degrees(misfit)) for misfit, _, name in found}
    if not found or not found[0][1]:
        return Guess(None, misfits)
    alone = len(found) == 1 or found[1][0] > CLEAR * max(found[0][0], SMALLEST)
    return Guess(load_sensor(found[0][2]) if alone else None, misfits)


def _of_rings(ring: Ints, elevation: Floats, sensor: SensorModel) -> float | None:
    """Misfit of the rings' medians to the rows they are nearest to, rad; None: another number or spacing of rings."""
    present = np.unique(ring)
    if not FEWEST_RINGS <= len(present) <= sensor.n_rings:
        return None
    medians = np.array([np.median(elevation[ring == r]) for r in present])
    order = np.argsort(medians)
    if len(present) == sensor.n_rings:
        return _rms(medians[order] - sensor.elevations)
    rows = sensor.nearest_ring(medians[order])
    steps = np.diff(present[order])
    if (np.diff(rows) != np.abs(steps)).any() or len(set(np.sign(steps))) > 1:
        return None
    return _rms(medians[order] - sensor.elevations[rows])


def _of_elevations(elevation: Floats, sensor: SensorModel) -> float | None:
    """Misfit of all returns to the rows they are nearest to, rad; None: too many rows are empty."""
    rows = sensor.nearest_ring(elevation)
    occupied = np.unique(rows)
    if len(occupied) < FEWEST_RINGS or len(occupied) < OCCUPIED * (np.ptp(occupied) + 1):
        return None
    return _rms(elevation - sensor.elevations[rows])


def _rms(off: Floats) -> float:
    return float(np.sqrt(np.mean(off**2)))
