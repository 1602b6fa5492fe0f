"""The sensor: where its rings look, how finely it samples, and how it errs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats, Ints, Value, frozen, shortened
from optshape_graph.errors import InputError


@dataclass(frozen=True, eq=False, repr=False)
class SensorModel(Value):
    """A spinning multi-beam LiDAR.

    Attributes:
        elevations: (R,) rad, strictly increasing: ring r looks at elevations[r].
        name: what results call it.
        azimuth_step: rad between two firings of a beam; None: estimated from the returns.
        range_noise: standard deviation of one range, metres.
        ring_bias: standard deviation over rings of the range bias that a ring keeps, metres.
        elevation_error: standard deviation over rings of how far elevations are off the table, rad. Makers state or are
            found to keep a twentieth to a tenth of a degree.
        brightness_bias: standard deviation of the range bias that all returns of a surface in a scan share, metres:
            dark ones come late, bright ones early.
        blooming: standard deviation of the azimuth by which a target seems to reach further on each side than its
            share of the beam says, rad: bright ones do.
        odd_ends: share of ring ends that are not what they seem: the last return a stray, or a few lost beyond it.
        beam_divergence: full angle of the beam, rad.
        beam_aperture: width of the beam where it leaves the sensor, metres.
        beam_crossing: where the beams cross, horizontal distance from the axis, metres; drivers report heights as if
            they met on the axis.
        azimuth_offsets: (R,) rad, each ring's azimuth relative to the sensor's at the time it fires; None: all 0.
        firing_phases: (R,) when each ring fires, as a share of the cycle of firings, in [0, 1); None: all at once.
            The sensor turns clockwise, seen from above, by an azimuth step in a cycle.
        range_resolution: ranges are multiples of it, metres; 0: not quantised.
        min_range: nearer returns are not reported, metres.
        max_range: farther returns are not reported, metres.

    Raises:
        InputError: elevations not increasing or out of +-90 deg, another number of azimuth offsets than of rings,
            a negative or non-finite parameter, or no room between min_range and max_range.
    """

    elevations: Floats
    name: str = "lidar"
    azimuth_step: float | None = None
    range_noise: float = 0.01
    ring_bias: float = 0.01
    elevation_error: float = np.radians(0.1)
    brightness_bias: float = 0.0
    blooming: float = 0.0
    odd_ends: float = 0.01
    beam_divergence: float = 0.0
    beam_aperture: float = 0.0
    beam_crossing: float = 0.0
    azimuth_offsets: Floats | None = None
    firing_phases: Floats | None = None
    range_resolution: float = 0.0
    min_range: float = 0.0
    max_range: float = np.inf

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
            "beam_divergence",
            "beam_aperture",
            "beam_crossing",
            "range_resolution",
            "min_range",
        ):
            value = getattr(self, field)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"sensor '{self.name}': {field} {value} is not a number >= 0")
        if not 0 < self.odd_ends < 1:
            raise InputError(f"sensor '{self.name}': odd_ends {self.odd_ends} is not a share above 0 and below 1")
        step = self.azimuth_step
        if step is not None and not (np.isfinite(step) and 0 < step < np.pi):
            raise InputError(f"sensor '{self.name}': azimuth step {step} rad is not within (0, pi)")
        if not self.max_range > self.min_range:
            raise InputError(f"sensor '{self.name}': max_range {self.max_range} m does not exceed {self.min_range} m")
        if self.azimuth_offsets is not None:
            offsets = frozen(self.azimuth_offsets)
            if offsets.shape != elevations.shape or not np.isfinite(offsets).all():
                raise InputError(
                    f"sensor '{self.name}': expected {len(elevations)} finite azimuth offsets, one per ring, "
                    f"found {offsets.size}"
                )
            object.__setattr__(self, "azimuth_offsets", offsets)
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

    def with_azimuth_step(self, step: float | None) -> SensorModel:
        """Return the sensor with another azimuth step, rad."""
        return replace(self, azimuth_step=step)

    def nearest_ring(self, elevations: ArrayLike) -> Ints:
        """(N,) index of the ring nearest to each of (N,) elevations, rad."""
        wanted = np.asarray(elevations, dtype=float)
        above = np.searchsorted(self.elevations, wanted).clip(1, max(self.n_rings - 1, 1))
        if self.n_rings == 1:
            return np.zeros(wanted.shape, dtype=np.int64)
        below = above - 1
        nearer_below = wanted - self.elevations[below] <= self.elevations[above] - wanted
        return np.where(nearer_below, below, above)
