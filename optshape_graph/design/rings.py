"""The heights at which horizontal rings cross a target, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.sensor import SensorModel


class Rings(Protocol):
    """A rule that puts rings on a polygon: their `heights` in several areas, of which one is lit at a time."""

    @property
    def half_turn_symmetric(self) -> bool:
        """Whether the rings of a polygon turned by half a turn are its rings turned by half a turn."""

    def heights(self, low: Floats, high: Floats) -> Floats:
        """Return ring heights (k, ..., m) in m areas of polygons of unit area from `low` to `high`, (...,)."""


@dataclass(frozen=True)
class UniformRings:
    """Rings in equal strips of the full height, at j / (per_area + 1) of a strip (paper, Section IV-A).

    Attributes:
        areas: number of strips m.
        per_area: number of rings in a strip.

    Raises:
        InputError: no area, or no ring.
    """

    areas: int = 5
    per_area: int = 4

    def __post_init__(self) -> None:
        if self.areas < 1 or self.per_area < 1:
            raise InputError(f"expected at least 1 area and 1 ring; found {self.areas} areas of {self.per_area} rings")

    @property
    def half_turn_symmetric(self) -> bool:
        """True: the rings lie symmetrically about the middle of the height."""
        return True

    def heights(self, low: Floats, high: Floats) -> Floats:
        """(k, ..., m) ring heights, in the unit of `low` and `high`, (...,)."""
        place = np.arange(1, self.per_area + 1)[:, None] / (self.per_area + 1)
        fractions = (np.arange(self.areas) + place) / self.areas
        fractions = fractions.reshape(self.per_area, *(1,) * np.ndim(low), self.areas)
        return np.asarray(low[..., None] + (high - low)[..., None] * fractions)


@dataclass(frozen=True, eq=False, repr=False)
class SensorRings(Value):
    """The rings of a sensor on an upright target that faces it.

    An area is a placement here: the target's centre at one of several heights between two rings, since the height of a
    target is not adjusted to a ring.

    Attributes:
        plane_heights: (k,) metres, where the rings meet the target's plane, from the target's centre, at the
            first placement, for a target of `area`.
        shifts: (m,) metres, how much lower the rings are at each placement.
        area: area of the target, square metres.
    """

    plane_heights: Floats
    shifts: Floats
    area: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "plane_heights", frozen(self.plane_heights))
        object.__setattr__(self, "shifts", frozen(self.shifts))

    @classmethod
    def of(
        cls, sensor: SensorModel, distance: float, height: float = 0.0, placements: int = 5, area: float = 1.0
    ) -> SensorRings:
        """Make the rings of `sensor` on a target at `distance`.

        Args:
            sensor: the sensor.
            distance: horizontal distance of the target's plane, metres.
            height: of the target's centre above the sensor, metres.
            placements: number of placements within the gap between the two rings nearest to the centre.
            area: area of the target, square metres.

        Raises:
            InputError: `distance` or `area` is not positive, no placement, or a sensor with a single ring.
        """
        if not (np.isfinite(distance) and distance > 0 and np.isfinite(area) and area > 0):
            raise InputError(f"expected a positive distance and area; found {distance} m and {area} m2")
        if placements < 1 or sensor.n_rings < 2:
            raise InputError(f"expected a placement and two rings; found {placements} and {sensor.n_rings}")
        heights = distance * np.tan(sensor.elevations) - height
        above = int(np.searchsorted(heights, 0.0).clip(1, len(heights) - 1))
        gap = heights[above] - heights[above - 1]
        return cls(heights, gap * np.arange(placements) / placements, area)

    @property
    def half_turn_symmetric(self) -> bool:
        """False: a sensor's rings are not spaced symmetrically."""
        return False

    def heights(self, low: Floats, high: Floats) -> Floats:
        """(k, ..., m) ring heights, for polygons of unit area about their centre."""
        plane = (self.plane_heights[:, None] - self.shifts) / np.sqrt(self.area)
        return np.broadcast_to(
            plane.reshape(len(plane), *(1,) * np.ndim(low), -1), (len(plane), *np.shape(low), len(self.shifts))
        )
