"""Guess which built-in sensor made a cloud, from the elevations of its returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.io.sensors import builtin_sensors, load_sensor
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel

FEWEST_RINGS = 4
"""Fewer rings do not identify a table."""

CHANCE = 0.25
"""A table fits if its misfit is below this fraction of the misfit of unrelated elevations."""

CLEAR = 2.0
"""The next best table must fit worse by this factor; otherwise there is no guess."""

SMALLEST = np.radians(0.005)
"""Misfits below this, rad, count as equal, since coordinates are rounded."""

FARTHEST_OFF = np.radians(0.5)
"""A table with a larger misfit, rad, tells nothing about the sensor."""

OCCUPIED = 0.9
"""Fraction of a table's rows, from the lowest to the highest seen, that must have returns in a cloud without rings."""


@dataclass(frozen=True)
class Guess:
    """The guess that the elevations allow.

    Attributes:
        sensor: the built-in sensor whose table fits; None: none fits, or several do.
        misfits: root mean square misfit in degrees, by the name of each candidate table, the best first.
    """

    sensor: SensorModel | None
    misfits: dict[str, float]

    def __str__(self) -> str:
        """Return the guess in a few words."""
        if self.sensor is not None:
            return f"{self.sensor.name} (elevations within {next(iter(self.misfits.values())):.3f} deg of its table)"
        if not self.misfits:
            return "none of the built-in tables is near"
        near = ", ".join(f"{name} ({misfit:.2f} deg)" for name, misfit in list(self.misfits.items())[:3])
        return f"no built-in table fits beyond doubt; near are {near}: the maker's file of the unit has its own"


def guess_sensor(scan: Scan) -> Guess:
    """Compare a cloud's elevations with all built-in tables.

    Args:
        scan: read without a sensor; its cloud may have rings, or not.
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
    sensor = load_sensor(found[0][2])
    numbered = scan.ring is None or _is_numbered_so(scan.ring, elevation, sensor)
    return Guess(sensor if alone and numbered else None, misfits)


def _of_rings(ring: Ints, elevation: Floats, sensor: SensorModel) -> float | None:
    """Return the misfit, rad, of the rings' medians to their nearest rows; None: another number or spacing of rings."""
    numbers, medians = _medians(ring, elevation)
    if not FEWEST_RINGS <= len(numbers) <= sensor.n_rings:
        return None
    if len(numbers) == sensor.n_rings:
        return _rms(medians - sensor.elevations)
    rows = sensor.nearest_ring(medians)
    steps = np.diff(numbers)
    if (np.diff(rows) != np.abs(steps)).any() or len(set(np.sign(steps))) > 1:
        return None
    return _rms(medians - sensor.elevations[rows])


def _is_numbered_so(ring: Ints, elevation: Floats, sensor: SensorModel) -> bool:
    """Return whether the ring numbers of a crop may be those of the rows that its elevations are on.

    Drivers count from the lowest or from the highest ring, from 0 or 1; where a 0 is there, it may be the first seen.
    """
    numbers, medians = _medians(ring, elevation)
    if len(numbers) == sensor.n_rings or numbers.min() == 0:
        return True
    row = int(sensor.nearest_ring(medians[:1])[0])
    return bool(numbers[0] - (row if numbers[1] > numbers[0] else sensor.n_rings - 1 - row) in (0, 1))


def _medians(ring: Ints, elevation: Floats) -> tuple[Ints, Floats]:
    """Return the numbers of the rings from the lowest up, and the median elevation of each, rad."""
    present = np.unique(ring)
    medians = np.array([np.median(elevation[ring == r]) for r in present])
    order = np.argsort(medians)
    return present[order], medians[order]


def _of_elevations(elevation: Floats, sensor: SensorModel) -> float | None:
    """Return the misfit, rad, of all returns to their nearest rows; None: too many rows are empty."""
    rows = sensor.nearest_ring(elevation)
    occupied = np.unique(rows)
    if len(occupied) < FEWEST_RINGS or len(occupied) < OCCUPIED * (np.ptp(occupied) + 1):
        return None
    return _rms(elevation - sensor.elevations[rows])


def _rms(off: Floats) -> float:
    return float(np.sqrt(np.mean(off**2)))
