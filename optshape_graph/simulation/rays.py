"""The rays that a spinning LiDAR fires in one revolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.errors import InputError
from optshape_graph.sensor import SensorModel

Sphere = tuple[Floats, float]
"""(3,) centre and radius, metres."""

MOST_RAYS = 20_000_000
"""Rays of a revolution at most: ten times those of the densest existing sensor."""


@dataclass(frozen=True, eq=False, repr=False)
class EdgeMargin(Value):
    """How far outside an edge a beam's axis may pass while the beam still returns, in radii of the beam.

    At a range r the beam's radius is an angle of (divergence + aperture / r) / 2.

    Attributes:
        radii: (N,) of each ray, or (1,) of all, in units of the beam's radius; if negative, the axis must pass that far
            inside.
        divergence: full angle of the beam, rad.
        aperture: width of the beam where it leaves the sensor, metres.
        further: azimuth by which a ray may pass further outside because of blooming, rad; it may be negative.
        axis: (3,) unit vector along that of the revolution, world frame.
    """

    radii: Floats
    divergence: float = 0.0
    aperture: float = 0.0
    further: float = 0.0
    axis: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def angle(self, index: Ints, ranges: Floats) -> Floats:
        """Return the margins (M,), rad, of rays (M,) at ranges (M,), metres."""
        return np.asarray(0.5 * at(self.radii, index) * (self.divergence + self.aperture / ranges))

    def widen(self, sphere: Sphere, distance: Floats) -> Floats:
        """Return radii (N,), metres, of widened spheres: rays that miss one miss its content by more than the margin.

        Args:
            sphere: around something.
            distance: (N,) of its centre from the rays' origins, metres.
        """
        # Twice the margin at the centre: it is an angle, and the content of the sphere may be up to twice as far.
        width = np.abs(self.radii).max(initial=0.0) * (self.divergence * distance + self.aperture)
        return np.asarray((sphere[1] + width + 2 * max(self.further, 0.0) * distance) * (1 + 1e-9))


NO_MARGIN = EdgeMargin(np.zeros(1))
"""Beams without width."""


def at(values: Floats, index: Ints) -> Floats:
    """Return the values (M, k), in their unit, of the rays at `index` (M,): the one row (1, k) if all rays share it."""
    return values if len(values) == 1 else values[index]


def unit_vectors(azimuth: Floats, elevation: Floats) -> Floats:
    """Return unit vectors (..., 3) at azimuths about z from x, and elevations, rad, of shapes that broadcast.

    Memory is laid out by coordinate, which makes products of many vectors several times faster.
    """
    cos_elevation = np.cos(elevation)
    vectors = np.empty((3, *np.broadcast_shapes(azimuth.shape, elevation.shape)))
    np.multiply(cos_elevation, np.cos(azimuth), out=vectors[0])
    np.multiply(cos_elevation, np.sin(azimuth), out=vectors[1])
    vectors[2] = np.sin(elevation)
    return np.moveaxis(vectors, 0, -1)


@dataclass(frozen=True, eq=False, repr=False)
class AngleErrors(Value):
    """Errors of the directions of a sensor unit's rings, relative to its file.

    Attributes:
        elevation: (R,) rad by which each ring looks higher.
        azimuth: (R,) rad by which it looks farther to the left.
    """

    elevation: Floats
    azimuth: Floats


@dataclass(frozen=True, eq=False, repr=False)
class Revolution(Value):
    """The rays of one revolution, LiDAR frame, in firing order: ring by ring in every column of azimuth.

    Attributes:
        sensor: whose rays they are.
        columns: (A,) azimuth of each column, rad, from half a turn before x to half a turn after.
        errors: of the rings' directions; None: no errors.
        spin_rate: revolutions per second.
    """

    sensor: SensorModel
    columns: Floats
    spin_rate: float = 10.0
    errors: AngleErrors | None = None

    @classmethod
    def of(
        cls, sensor: SensorModel, phase: float = 0.0, spin_rate: float = 10.0, errors: AngleErrors | None = None
    ) -> Revolution:
        """Return the revolution with columns at azimuth k step + phase, k integer.

        Args:
            sensor: the sensor; its azimuth step holds for the spin rate (see `spinning_at`).
            phase: rad.
            spin_rate: revolutions per second; sets the times.
            errors: of the rings' directions.

        Raises:
            InputError: the sensor's azimuth step is not known, or so small that there are too many rays.
        """
        step = sensor.azimuth_step
        if step is None:
            raise InputError(f"sensor '{sensor.name}' has no azimuth step; simulation needs one (azimuth_step_deg)")
        rays = 2 * np.pi / step * sensor.n_rings
        if rays > MOST_RAYS:
            raise InputError(
                f"sensor '{sensor.name}': {rays:.3g} rays in a revolution of {sensor.n_rings} rings, "
                f"{np.degrees(step):.3g} deg apart; at most {MOST_RAYS:.0e} are simulated"
            )
        first = int(np.ceil(-np.pi / step - 1e-9))
        columns = step * np.arange(first, first + round(2 * np.pi / step), dtype=float) + phase
        return cls(sensor, columns, spin_rate, errors)

    def __len__(self) -> int:
        return len(self.columns) * self.sensor.n_rings

    def facing(self, spheres: Sequence[Sphere]) -> Revolution:
        """Return the columns in which a ray may pass one of some spheres, in the LiDAR frame."""
        widest = float(np.abs(self._looks[1]).max())
        keep = np.zeros(len(self.columns), dtype=bool)
        for (x, y, _), radius in spheres:
            away = np.hypot(x, y)
            if away <= radius:
                return self
            aside = np.abs((self.columns - np.arctan2(y, x) + np.pi) % (2 * np.pi) - np.pi)
            keep |= aside <= np.arcsin(radius / away) + widest
        return replace(self, columns=self.columns[keep])

    @cached_property
    def directions(self) -> Floats:
        """Return the directions (N, 3) of the rays, unit vectors."""
        elevations, offsets = self._looks
        return unit_vectors(self.columns[:, None] + offsets, elevations[None, :]).reshape(-1, 3)

    @cached_property
    def _looks(self) -> tuple[Floats, Floats]:
        """Return the true elevation and azimuth offset (R,) of each ring."""
        offsets = np.zeros(self.sensor.n_rings) if self.sensor.azimuth_offsets is None else self.sensor.azimuth_offsets
        if self.errors is None:
            return self.sensor.elevations, offsets
        return self.sensor.elevations + self.errors.elevation, offsets + self.errors.azimuth

    @cached_property
    def _reported(self) -> SensorModel:
        return self.sensor.as_reported

    def ring(self, index: Ints) -> Ints:
        """Return the ring (M,) of each of the rays (M,)."""
        return index % self.sensor.n_rings

    def elevation(self, index: Ints) -> Floats:
        """Return the reported elevation (M,) of each of the rays (M,), rad."""
        return np.asarray(self._reported.elevations[self.ring(index)])

    def azimuth(self, index: Ints) -> Floats:
        """Return the reported azimuth (M,) of each of the rays (M,), rad."""
        azimuth = self.columns[index // self.sensor.n_rings]
        if self._reported.azimuth_offsets is not None:
            azimuth = azimuth + self._reported.azimuth_offsets[self.ring(index)]
        return azimuth

    def time(self, index: Ints) -> Floats:
        """Return the times (M,), seconds, at which rays (M,) are fired; the column at azimuth 0 is fired at 0."""
        return self.columns[index // self.sensor.n_rings] / (2 * np.pi * self.spin_rate)
