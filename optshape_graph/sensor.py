"""The sensor: where its rings look, how finely it samples, and how it errs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats, Ints, Value, frozen, shortened
from optshape_graph.errors import InputError

ELEVATION_ERROR, AZIMUTH_ERROR = np.radians(0.1), np.radians(0.05)
"""Standard deviations, over rings, of the errors of elevation and azimuth of an unknown sensor, rad."""


@dataclass(frozen=True, eq=False, repr=False)
class SensorModel(Value):
    """A spinning multi-beam LiDAR.

    Attributes:
        elevations: (R,) rad, strictly increasing: ring r looks at elevations[r].
        name: what results call it.
        azimuth_step: rad between two firings of a beam; None: estimated from the returns.
        range_noise: standard deviation of one range, metres.
        ring_bias: standard deviation over rings of the range bias that a ring keeps, metres.
        elevation_error: standard deviation, over rings, of the error of a ring's elevation, rad. Makers state, or
            measurements show, a twentieth to a tenth of a degree. None: a tenth of a degree, or 0 for a beam without
            width, which only a simulator has.
        azimuth_error: standard deviation, over rings, of the error of a ring's azimuth, rad. None: a twentieth of a
            degree, or 0 for a beam without width.
        brightness_bias: standard deviation of the range bias that all returns of a surface in a scan share, metres:
            dark ones come late, bright ones early.
        blooming: standard deviation of the azimuth by which a target seems to reach further on each side than its
            part of the beam explains, rad; bright targets bloom.
        odd_ends: share of ring ends whose last return is a stray, or beyond which a few returns are lost.
        beam_divergence: full angle of the beam, rad.
        beam_aperture: width of the beam where it leaves the sensor, metres.
        beam_crossing: where the beams cross, horizontal distance from the axis, metres; drivers report heights as if
            they met on the axis.
        azimuth_offsets: (R,) rad, each ring's azimuth relative to the sensor's at the time it fires; None: all 0.
        firing_phases: (R,) when each ring fires, as a fraction of the firing cycle, in [0, 1); None: all at once.
            The sensor turns clockwise, seen from above, by an azimuth step in a cycle.
        firing_period: duration of a firing cycle, seconds.
        range_resolution: ranges are multiples of it, metres; 0: not quantised.
        min_range: nearer returns are not reported, metres.
        max_range: farther returns are not reported, metres.
        range_bias: (R,) metres by which each ring measures too far; None: 0.
        range_bias_sd: (R,) standard deviation of each ring's range bias about `range_bias`, metres; None: `ring_bias`.
        elevation_sd: (R,) of each ring's elevation, rad; None: `elevation_error`.
        azimuth_sd: (R,) of each ring's azimuth offset, rad; None: `azimuth_error`.
        firing_sd: (R,) of each ring's firing phase; None: 0.
        common_range_sd: standard deviation of a range bias that all rings share, beside their own, metres.
        common_elevation_sd: standard deviation of an error of elevation that all rings share, rad.
        common_azimuth_sd: standard deviation of an error of azimuth that all rings share, rad.
        range_trend_sd: standard deviation of a range bias that grows with the ring's elevation, from the mean of the
            table on, metres per rad.
        elevation_trend_sd: the same of an error of elevation, rad per rad.
        azimuth_trend_sd: the same of an error of azimuth, rad per rad.
        reported_elevations: (R,) rad, by which the driver makes points of ranges; None: `elevations`.
        reported_azimuth_offsets: (R,) rad, by which the driver makes points of ranges; None: `azimuth_offsets`.
        edge_offset: how far inside an edge the returns end, beside the part of the step, in beam widths: the mean.
        edge_offset_sd: standard deviation of that offset, in beam widths. The default: uniform over the beam.

    Raises:
        InputError: elevations that do not increase or exceed +-90 deg, a list with other than one number per ring, a
            negative or non-finite parameter, or a max_range that does not exceed min_range.
    """

    elevations: Floats
    name: str = "lidar"
    azimuth_step: float | None = None
    range_noise: float = 0.01
    ring_bias: float = 0.01
    elevation_error: float | None = None
    azimuth_error: float | None = None
    brightness_bias: float = 0.0
    blooming: float = 0.0
    odd_ends: float = 0.01
    beam_divergence: float = 0.0
    beam_aperture: float = 0.0
    beam_crossing: float = 0.0
    azimuth_offsets: Floats | None = None
    firing_phases: Floats | None = None
    firing_period: float = 1e-6
    range_resolution: float = 0.0
    min_range: float = 0.0
    max_range: float = np.inf
    range_bias: Floats | None = None
    range_bias_sd: Floats | None = None
    elevation_sd: Floats | None = None
    azimuth_sd: Floats | None = None
    firing_sd: Floats | None = None
    common_range_sd: float = 0.0
    common_elevation_sd: float = 0.0
    common_azimuth_sd: float = 0.0
    range_trend_sd: float = 0.0
    elevation_trend_sd: float = 0.0
    azimuth_trend_sd: float = 0.0
    reported_elevations: Floats | None = None
    reported_azimuth_offsets: Floats | None = None
    edge_offset: float = 0.0
    edge_offset_sd: float = 1 / np.sqrt(12)

    def __post_init__(self) -> None:
        elevations = frozen(self.elevations)
        if elevations.ndim != 1 or len(elevations) == 0 or not np.isfinite(elevations).all():
            raise InputError(f"sensor '{self.name}': expected a list of finite elevations")
        if (np.diff(elevations) <= 0).any():
            k = int((np.diff(elevations) <= 0).argmax())
            raise InputError(
                f"sensor '{self.name}': elevations run from the lowest ring up; "
                f"number {k + 1} ({np.degrees(elevations[k + 1]):g} deg) does not exceed "
                f"number {k} ({np.degrees(elevations[k]):g} deg)"
            )
        if np.abs(elevations).max() >= np.pi / 2:
            raise InputError(
                f"sensor '{self.name}': elevation {np.degrees(np.abs(elevations).max()):g} deg is not within +-90 deg"
            )
        for field in (
            "range_noise",
            "ring_bias",
            "elevation_error",
            "brightness_bias",
            "blooming",
            "azimuth_error",
            "edge_offset_sd",
            "common_range_sd",
            "common_elevation_sd",
            "common_azimuth_sd",
            "range_trend_sd",
            "elevation_trend_sd",
            "azimuth_trend_sd",
            "beam_divergence",
            "beam_aperture",
            "beam_crossing",
            "firing_period",
            "range_resolution",
            "min_range",
        ):
            value = getattr(self, field)
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise InputError(f"sensor '{self.name}': {field} {value} is not a number >= 0")
        if not 0 < self.odd_ends < 1:
            raise InputError(f"sensor '{self.name}': odd_ends {self.odd_ends} is not a share above 0 and below 1")
        step = self.azimuth_step
        if step is not None and not (np.isfinite(step) and 0 < step < np.pi):
            raise InputError(f"sensor '{self.name}': azimuth step {step} rad is not within (0, pi)")
        if not self.max_range > self.min_range:
            raise InputError(f"sensor '{self.name}': max_range {self.max_range} m does not exceed {self.min_range} m")
        if not np.isfinite(self.edge_offset):
            raise InputError(f"sensor '{self.name}': edge_offset {self.edge_offset} is not a finite number")
        for field, what in _BY_RING.items():
            values = getattr(self, field)
            if values is None:
                continue
            values = frozen(values)
            if values.shape != elevations.shape or not np.isfinite(values).all():
                raise InputError(
                    f"sensor '{self.name}': expected {len(elevations)} finite {what}, one per ring, found {values.size}"
                )
            if field.endswith("_sd") and values.min() < 0:
                raise InputError(f"sensor '{self.name}': {what}: {values.min():g} is not a number >= 0")
            object.__setattr__(self, field, values)
        if self.firing_phases is not None:
            phases = frozen(self.firing_phases)
            if phases.shape != elevations.shape or not ((phases >= 0) & (phases < 1)).all():
                raise InputError(
                    f"sensor '{self.name}': expected {len(elevations)} firing times within the firing period, one per "
                    f"ring, found {phases.size} from {phases.min(initial=0.0):g} to {phases.max(initial=0.0):g} periods"
                )
            object.__setattr__(self, "firing_phases", phases)
        object.__setattr__(self, "elevations", elevations)

    def __repr__(self) -> str:
        low, high = np.degrees(self.elevations[[0, -1]])
        return shortened(f"SensorModel('{self.name}', {self.n_rings} rings, {low:.4g} to {high:.4g} deg)")

    @property
    def n_rings(self) -> int:
        """Number of rings."""
        return len(self.elevations)

    @property
    def range_bias_sds(self) -> Floats:
        """(R,) standard deviation of each ring's range bias, metres."""
        return self._by_ring(self.range_bias_sd, self.ring_bias)

    @property
    def elevation_sds(self) -> Floats:
        """(R,) standard deviation of each ring's elevation, rad."""
        return self._by_ring(self.elevation_sd, self._angle(self.elevation_error, ELEVATION_ERROR))

    @property
    def azimuth_sds(self) -> Floats:
        """(R,) standard deviation of each ring's azimuth, rad: of its offset, and of when it fires."""
        sd = self._by_ring(self.azimuth_sd, self._angle(self.azimuth_error, AZIMUTH_ERROR))
        return sd if self.firing_sd is None else np.hypot(sd, self.firing_sd * (self.azimuth_step or 0.0))

    @property
    def calibrated(self) -> bool:
        """Whether the file says of each ring how far it may be off."""
        return any(sd is not None for sd in (self.range_bias_sd, self.elevation_sd, self.azimuth_sd))

    @property
    def trend(self) -> Floats:
        """(R,) what a trend of one adds to each ring: its elevation less the mean of the table, rad."""
        return np.asarray(self.elevations - self.elevations.mean())

    def _angle(self, stated: float | None, usual: float) -> float:
        if stated is not None:
            return stated
        return usual if self.beam_divergence + self.beam_aperture > 0 else 0.0

    def _by_ring(self, values: Floats | None, of_all: float) -> Floats:
        return np.full(self.n_rings, of_all) if values is None else values

    @property
    def deviations(self) -> tuple[Floats, Floats, Floats]:
        """(R,) metres by which ranges are too long, and (R,) rad by which elevations, and azimuths, are too low."""
        nothing = np.zeros(self.n_rings)
        range_bias = nothing if self.range_bias is None else self.range_bias
        reported, offsets = self.reported_elevations, self.reported_azimuth_offsets
        elevation = nothing if reported is None else self.elevations - reported
        own = nothing if self.azimuth_offsets is None else self.azimuth_offsets
        return range_bias, elevation, nothing if offsets is None else own - offsets

    @property
    def put_right(self) -> SensorModel:
        """The sensor of clouds that `scan.put_right` corrected: its rings have no known deviations."""
        if self.range_bias is None and self.reported_elevations is None and self.reported_azimuth_offsets is None:
            return self
        return replace(self, range_bias=None, reported_elevations=None, reported_azimuth_offsets=None)

    @property
    def as_reported(self) -> SensorModel:
        """The sensor with the elevations and azimuth offsets of the driver's table, which the clouds come with."""
        elevations = self.elevations if self.reported_elevations is None else self.reported_elevations
        offsets = self.azimuth_offsets if self.reported_azimuth_offsets is None else self.reported_azimuth_offsets
        return replace(self.put_right, elevations=elevations, azimuth_offsets=offsets)

    def with_azimuth_step(self, step: float | None) -> SensorModel:
        """Return the sensor with another azimuth step, rad."""
        return replace(self, azimuth_step=step)

    def nearest_ring(self, elevations: ArrayLike) -> Ints:
        """Return the index (N,) of the ring nearest to each of the elevations (N,), rad."""
        wanted = np.asarray(elevations, dtype=float)
        above = np.searchsorted(self.elevations, wanted).clip(1, max(self.n_rings - 1, 1))
        if self.n_rings == 1:
            return np.zeros(wanted.shape, dtype=np.int64)
        below = above - 1
        nearer_below = wanted - self.elevations[below] <= self.elevations[above] - wanted
        return np.where(nearer_below, below, above)


def angle_sds(sensor: SensorModel | None, ring: Ints) -> tuple[Floats, Floats]:
    """Return the standard deviations (N,) of the errors of rings (N,) in elevation and in azimuth, rad.

    Args:
        sensor: whose rings; None: an unknown sensor.
        ring: (N,).
    """
    if sensor is None or ring.max(initial=0) >= sensor.n_rings:
        return np.full(len(ring), ELEVATION_ERROR), np.full(len(ring), AZIMUTH_ERROR)
    return sensor.elevation_sds[ring], sensor.azimuth_sds[ring]


def total_angle_sds(sensor: SensorModel | None, ring: Ints) -> tuple[Floats, Floats]:
    """Return the standard deviations (N,) of where rings look in elevation and azimuth, all errors included, rad.

    Args:
        sensor: whose rings; None: an unknown sensor.
        ring: (N,).
    """
    up, left = angle_sds(sensor, ring)
    if sensor is None:
        return up, left
    trend = ring_trend(sensor, ring)
    return (
        np.sqrt(up**2 + sensor.common_elevation_sd**2 + (sensor.elevation_trend_sd * trend) ** 2),
        np.sqrt(left**2 + sensor.common_azimuth_sd**2 + (sensor.azimuth_trend_sd * trend) ** 2),
    )


def ring_trend(sensor: SensorModel, ring: Ints) -> Floats:
    """Return what a trend of one adds to rings (N,), rad: nothing to those that the sensor doesn't have.

    Args:
        sensor: whose rings.
        ring: (N,).
    """
    return sensor.trend[ring] if ring.max(initial=0) < sensor.n_rings else np.zeros(len(ring))


_BY_RING = {
    "azimuth_offsets": "azimuth offsets",
    "range_bias": "range biases",
    "range_bias_sd": "standard deviations of range biases",
    "elevation_sd": "standard deviations of elevations",
    "azimuth_sd": "standard deviations of azimuth offsets",
    "firing_sd": "standard deviations of firing times",
    "reported_elevations": "reported elevations",
    "reported_azimuth_offsets": "reported azimuth offsets",
}
"""Fields with a number for each ring, and what messages call them."""
