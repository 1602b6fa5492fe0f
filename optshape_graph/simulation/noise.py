"""Errors of simulated returns: noise, biases, quantisation, lost returns and partial hits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import brentq

from optshape_graph._arrays import Bools, Floats
from optshape_graph.errors import InputError
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation.rays import AngleErrors, EdgeMargin


@dataclass(frozen=True)
class NoiseModel:
    """Errors of measurements, in the sensor's spherical coordinates.

    A ray is fired at its nominal azimuth and elevation and meets the scene there. Range, azimuth and elevation are then
    measured with independent normal errors, and the point is reported at the measured values, as in the paper's
    simulator. (With an error of the encoder, a ray is fired elsewhere than it is reported; on a plane the points are
    the same to first order.)

    Attributes:
        range_noise: standard deviation of one range, metres.
        azimuth_noise: standard deviation of one azimuth, rad.
        elevation_noise: standard deviation of one elevation, rad.
        ring_bias: standard deviation over rings of the range bias that a ring keeps, metres.
        elevation_error: standard deviation, over rings, of the error of a ring's elevation, rad.
        azimuth_error: standard deviation, over rings, of the error of a ring's azimuth, rad.
        brightness_bias: standard deviation of the range bias of each surface in a scan, metres.
        blooming: standard deviation, over scans, of the azimuth by which targets reach further on each side, rad.
        odd_ends: share of ring ends on targets at which one firing more returns, or one to three fewer.
        range_resolution: step to which ranges are rounded, metres; 0: not rounded.
        dropout: probability that a return at normal incidence is lost. At incidence i it is dropout**cos(i), so
            that nothing returns from a surface seen edge-on.
        hit_fraction: a beam returns from a target if at least this fraction of its footprint lies on it; with 0.5 its
            axis decides. The footprint is cut by a half plane, which is right except within its width of a vertex.
        edge_spread: half the width of a uniform distribution of the place at which a beam begins to return, about that
            of `hit_fraction`, in beam radii; drawn once for a scan and again for every ray. In reality it depends on
            the background, the reflectance and the threshold, which are not modelled.
        common_edge_spread: `edge_spread` of the part that is drawn once for a scan; None: the same; 0: no such part.
        random_phase: whether the azimuth grid is shifted by a random part of a step in every revolution, as for
            sensors that do not lock their phase.
        rings: a calibrated sensor, whose file says how large each ring's errors are, and what all rings share; None:
            errors are as large as `ring_bias`, `elevation_error` and `azimuth_error` say, each ring's by itself.

    Raises:
        InputError: a standard deviation, resolution or probability outside its range.
    """

    range_noise: float = 0.0
    azimuth_noise: float = 0.0
    elevation_noise: float = 0.0
    ring_bias: float = 0.0
    elevation_error: float = 0.0
    azimuth_error: float = 0.0
    brightness_bias: float = 0.0
    blooming: float = 0.0
    odd_ends: float = 0.0
    range_resolution: float = 0.0
    dropout: float = 0.0
    hit_fraction: float = 0.5
    edge_spread: float = 0.0
    common_edge_spread: float | None = None
    random_phase: bool = False
    rings: SensorModel | None = None

    def __post_init__(self) -> None:
        for field in (
            "range_noise",
            "azimuth_noise",
            "elevation_noise",
            "ring_bias",
            "elevation_error",
            "azimuth_error",
            "brightness_bias",
            "blooming",
            "range_resolution",
            "edge_spread",
            "common_edge_spread",
        ):
            value = getattr(self, field)
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise InputError(f"noise: {field} {value} is not a number >= 0")
        if not 0 <= self.odd_ends < 1:
            raise InputError(f"noise: share of odd ring ends {self.odd_ends} is not a share below 1")
        if not 0 <= self.dropout < 1:
            raise InputError(f"noise: dropout {self.dropout} is not a probability below 1")
        if not 0 < self.hit_fraction < 1:
            raise InputError(f"noise: hit fraction {self.hit_fraction} is not within (0, 1)")

    @classmethod
    def of(cls, sensor: SensorModel) -> NoiseModel:
        """Return the errors of the sensor's own model: noise, errors of rings, resolution, blooming and odd ring ends.

        The azimuth phase is free, and whether a partial hit returns is uniformly distributed over the beam.
        """
        return cls(
            range_noise=sensor.range_noise,
            ring_bias=_rms(sensor.range_bias_sds),
            elevation_error=_rms(sensor.elevation_sds),
            azimuth_error=_rms(sensor.azimuth_sds),
            brightness_bias=sensor.brightness_bias,
            blooming=sensor.blooming,
            odd_ends=sensor.odd_ends,
            range_resolution=sensor.range_resolution,
            edge_spread=1.0,
            random_phase=True,
            rings=sensor if sensor.calibrated else None,
        )

    @classmethod
    def level(cls, level: int, range_only: bool = False) -> NoiseModel:
        """Return one of the paper's noise levels 0 to 4.

        Args:
            level: 0 (none) to 4, as the paper's released settings define them; its charts show 0, 1 and 3.
            range_only: leave out the angular part, as the paper's stored results seem to do.

        Raises:
            InputError: there is no such level.
        """
        if level not in LEVELS:
            raise InputError(f"noise level {level} is not one of {', '.join(map(str, LEVELS))}")
        range_noise, azimuth_deg, elevation_deg = LEVELS[level]
        angular = 0.0 if range_only else 1.0
        return cls(
            range_noise=range_noise,
            azimuth_noise=angular * np.radians(azimuth_deg),
            elevation_noise=angular * np.radians(elevation_deg),
        )

    def jittered(self) -> NoiseModel:
        """Return the same noise with a free azimuth phase."""
        return replace(self, random_phase=True)

    @cached_property
    def edge_shift(self) -> float:
        """Largest distance beyond an edge at which a beam's axis may pass and the beam still return, in beam radii.

        A half plane whose border is x radii from the centre of a disc covers (arccos x - x sqrt(1 - x^2)) / pi of it.
        """
        if self.hit_fraction == 0.5:
            return 0.0

        def excess(x: float) -> float:
            return float((np.arccos(x) - x * np.sqrt(1 - x * x)) / np.pi - self.hit_fraction)

        return float(brentq(excess, -1.0, 1.0, xtol=1e-12))

    def draw_range_bias(self, n_rings: int, rng: np.random.Generator) -> Floats:
        """Draw the range bias (n_rings,) of each ring, metres: once for a sensor, or once for a scan."""
        if self.rings is not None:
            of = self.rings
            return _of_rings(of, of.range_bias_sds, of.common_range_sd, of.range_trend_sd, rng)
        return rng.normal(0.0, self.ring_bias, n_rings) if self.ring_bias > 0 else np.zeros(n_rings)

    def draw_brightness_bias(self, n_surfaces: int, rng: np.random.Generator) -> Floats:
        """Draw the range bias (n_surfaces,) of each surface, metres."""
        return rng.normal(0.0, self.brightness_bias, n_surfaces) if self.brightness_bias > 0 else np.zeros(n_surfaces)

    def draw_angle_errors(self, n_rings: int, rng: np.random.Generator) -> AngleErrors:
        """Draw the errors of the rings' directions: once for a sensor, or once for a scan.

        Args:
            n_rings: number of rings.
            rng: source of randomness; its later numbers do not depend on this call.
        """
        own = rng.spawn(1)[0]
        if self.rings is not None:
            of = self.rings
            return AngleErrors(
                _of_rings(of, of.elevation_sds, of.common_elevation_sd, of.elevation_trend_sd, own),
                _of_rings(of, of.azimuth_sds, of.common_azimuth_sd, of.azimuth_trend_sd, own),
            )
        return AngleErrors(
            self.elevation_error * own.normal(size=n_rings), self.azimuth_error * own.normal(size=n_rings)
        )

    def draw_phase(self, step: float, rng: np.random.Generator) -> float:
        """Draw the azimuth by which a revolution's grid is shifted, rad; 0 unless the phase is free."""
        return float(rng.uniform(0.0, step)) if self.random_phase else 0.0

    def widest_edge_margin(self, sensor: SensorModel) -> EdgeMargin:
        """Return a margin that no ray's margin exceeds."""
        widest = 1.0 + self.edge_spread + max(self.edge_spread, self.common_edge_spread or 0.0)
        further = MOST_BLOOMING * self.blooming
        return EdgeMargin(np.array([widest]), sensor.beam_divergence, sensor.beam_aperture, further)

    def draw_edge_margin(self, sensor: SensorModel, n_rays: int, rng: np.random.Generator) -> EdgeMargin:
        """Draw how far outside an edge each beam's axis may pass while the beam still returns.

        Args:
            sensor: whose beams.
            n_rays: number of rays.
            rng: source of randomness.
        """
        radii = np.array([self.edge_shift])
        if self.edge_spread > 0:
            spread = self.edge_spread
            common = spread if self.common_edge_spread is None else self.common_edge_spread
            radii = radii + rng.uniform(-common, common) + rng.uniform(-spread, spread, n_rays)
        further = (
            float(np.clip(rng.normal(), -MOST_BLOOMING, MOST_BLOOMING)) * self.blooming if self.blooming > 0 else 0.0
        )
        return EdgeMargin(radii, sensor.beam_divergence, sensor.beam_aperture, further)

    def draw_survivors(self, cos_incidence: Floats, rng: np.random.Generator) -> Bools:
        """Draw (N,) whether returns at cosines of incidence (N,) are detected."""
        if self.dropout == 0.0:
            return np.ones(len(cos_incidence), dtype=bool)
        return np.asarray(rng.uniform(size=len(cos_incidence)) >= self.dropout**cos_incidence)

    def measure(
        self, ranges: Floats, azimuth: Floats, elevation: Floats, bias: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Floats, Floats]:
        """Return measured ranges (N,), metres, azimuths and elevations, rad, of true ones.

        Args:
            ranges: (N,) metres.
            azimuth: (N,) rad.
            elevation: (N,) rad.
            bias: (N,) range bias of each return's ring, metres.
            rng: source of randomness.
        """
        ranges = ranges + bias
        if self.range_noise > 0:
            ranges = ranges + rng.normal(0.0, self.range_noise, len(ranges))
        if self.range_resolution > 0:
            ranges = np.round(ranges / self.range_resolution) * self.range_resolution
        if self.azimuth_noise > 0:
            azimuth = azimuth + rng.normal(0.0, self.azimuth_noise, len(ranges))
        if self.elevation_noise > 0:
            elevation = elevation + rng.normal(0.0, self.elevation_noise, len(ranges))
        return ranges, azimuth, elevation


MOST_BLOOMING = 4.0
"""Largest blooming of a target, in standard deviations."""


def _of_rings(sensor: SensorModel, own: Floats, common: float, trend: float, rng: np.random.Generator) -> Floats:
    """Draw errors (R,) of a sensor's rings: each one's own (R,), one that all share, and a trend with the elevation."""
    shared = common * rng.normal() + trend * rng.normal() * sensor.trend
    return np.asarray(own * rng.normal(size=len(own)) + shared)


def _rms(sds: Floats) -> float:
    return float(sds[0]) if (sds == sds[0]).all() else float(np.sqrt(np.mean(sds**2)))


LEVELS: dict[int, tuple[float, float, float]] = {
    0: (0.0, 0.0, 0.0),
    1: (0.01, 0.1, 0.1),
    2: (0.03, 0.2, 0.2),
    3: (0.03, 0.3, 0.3),
    4: (0.05, 0.5, 0.5),
}
"""Noise levels of the paper's released settings: standard deviations of range (m), azimuth and elevation (deg)."""

IDEAL = NoiseModel()
"""The geometry alone."""
