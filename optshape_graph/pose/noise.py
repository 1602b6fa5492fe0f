"""What the sensor's errors do to the residuals of a target: plane rows, edge rows, and what they share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.edges import leftward, upward
from optshape_graph.factors.measurement import TemplateMeasurement, template_rows
from optshape_graph.factors.static import AZIMUTH, ELEVATION, RANGE_BIAS, BiasedMeasurement, SharedError
from optshape_graph.pose.options import PoseOptions
from optshape_graph.scan import Scan
from optshape_graph.sensor import AZIMUTH_ERROR, ELEVATION_ERROR, SensorModel


@dataclass(frozen=True)
class EdgeNoise:
    """How ring ends scatter about the edge beside the quantisation along the ring.

    A return near an edge comes from part of the beam. Which part decides is a matter of reflectance and threshold,
    so the edge seems to lie further out or in, across the edge: by something common to a scan, and by something
    of each point's own, either uniform over at most the beam's width.

    Attributes:
        divergence: full angle of the beam, rad.
        aperture: width of the beam where it leaves the sensor, metres.
        options: of them the target's flatness, and which ring ends are lost.
        offset: mean of the offset that all edge points of a scan share, in beam widths.
        common: its standard deviation.
        angles: standard deviations, rad, of the elevations and of the azimuths of the sensor's rings; None: unknown.
    """

    divergence: float
    aperture: float
    options: PoseOptions
    offset: float = SensorModel.edge_offset
    common: float = SensorModel.edge_offset_sd
    angles: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    OWN = 1 / np.sqrt(12)
    """Standard deviation of each edge point's own offset, in beam widths."""

    @classmethod
    def of(cls, sensor: SensorModel | None, options: PoseOptions = PoseOptions()) -> EdgeNoise:
        """Take the beam of a sensor; an unknown one has a beam of 3 mrad, a centimetre wide at first."""
        if sensor is None:
            return cls(3e-3, 0.01, options)
        angles = tuple(sensor.elevation_sds.tolist()), tuple(sensor.azimuth_sds.tolist())
        beam = sensor.beam_divergence, sensor.beam_aperture
        return cls(*beam, options, sensor.edge_offset, sensor.edge_offset_sd, angles)

    def angle_sds(self, ring: Ints) -> tuple[Floats, Floats]:
        """Return the standard deviations (N,) of elevation and azimuth, rad, that rings (N,) are off the table by."""
        if self.angles is None:
            return np.full(len(ring), ELEVATION_ERROR), np.full(len(ring), AZIMUTH_ERROR)
        elevation, azimuth = np.array(self.angles)
        return elevation[ring], azimuth[ring]

    @property
    def ideal(self) -> bool:
        """Whether the beam has no width, so that it ends where the target does."""
        return self.divergence + self.aperture == 0

    def width(self, ranges: Floats) -> Floats:
        """Width of the beam at ranges (...), metres; an ideal beam's still is a tenth of a millimetre."""
        return np.maximum(self.aperture + self.divergence * ranges, 1e-4)


FINEST_STEP = 0.2
"""Step across an edge, in beam widths, below which a ring runs along it: where it ends is up to a vertex, not to the
rays that happen to return, and counts as at this step."""


def outermost_return(step: Floats) -> tuple[Floats, Floats]:
    """How a ring's last return lies and scatters about an edge where several rays fall within the beam's width of it.

    It is the outermost of those that happened to return: further out than a single ray would be, and scattering less.

    Args:
        step: (...) how far across the edge the ring's next ray is, in beam widths.

    Returns:
        How much further out it lies, in beam widths, and its scatter against that of a single ray, each (...).
    """
    steps, shift, share = _outermost()
    step = np.maximum(step, FINEST_STEP)
    return np.interp(step, steps, shift), np.interp(step, steps, share)


@cache
def _outermost() -> tuple[Floats, Floats, Floats]:
    """The table behind `outermost_return`, by step.

    Rays a step apart, in any phase, each return with a probability that falls from 1 to 0 over the beam's width. What
    the phase itself shifts and scatters is taken out.
    """
    steps, phase = np.geomspace(FINEST_STEP, 1.0, 8), (np.arange(16) + 0.5) / 16
    x = np.linspace(-1.5, 0.5, 401)
    table = []
    for step in steps:
        place = step * (phase[:, None] + np.arange(-np.ceil(1.5 / step), np.ceil(0.5 / step) + 1))
        returns = np.clip(0.5 - place, 0.0, 1.0)
        # The outermost lies before x where no ray beyond x returns.
        before = np.array([np.where(place > at, 1.0 - returns, 1.0).prod(axis=1).mean() for at in x])
        middle, mass = 0.5 * (x[1:] + x[:-1]), np.diff(before)
        mean = mass @ middle / mass.sum()
        variance = mass @ middle**2 / mass.sum() - mean**2
        table.append((mean + step / 2, np.sqrt(12.0 * max(variance - step**2 / 12.0, 0.0))))
    shift, share = np.array(table).T
    return steps, np.maximum(shift, 0.0), np.minimum(share, 1.0)


@dataclass(frozen=True, eq=False, repr=False)
class PlaneReturns(Value):
    """Every return against the plane of the target: e_x . (R p + t) - c, with its noise.

    A range error moves a return along its ray, and so moves the residual and the row's own coefficients together:
    rows of the returns themselves would be biased (errors in variables), most of all across the rings, where nothing
    but the errors varies within a ring. So p is where the ray meets a plane near the true one, and c carries the rest.

    Attributes:
        points: (N, 3) p, metres, LiDAR frame.
        offset: (N,) c, metres.
        sigma: (N,) standard deviation of each residual, metres.
        errors: (K,) what the returns share: the range bias of each ring that hit the target.
        bias: (N, K) how far a standard deviation of each moves each residual, in units of `sigma`.
        coupling: (N, 3) covariance of each residual with its p, square metres: an azimuth error moves both.
    """

    points: Floats
    offset: Floats
    sigma: Floats
    errors: tuple[SharedError, ...]
    bias: Floats
    coupling: Floats

    def select(self, mask: Bools) -> PlaneReturns:
        """Return some of them, of a mask (N,)."""
        rows = {name: getattr(self, name)[mask] for name in ("points", "offset", "sigma", "bias", "coupling")}
        return replace(self, **rows)

    def with_angles(self, normal: Floats, ring: Ints, noise: EdgeNoise) -> PlaneReturns:
        """Return them with an error of each ring's elevation and of its azimuth.

        Args:
            normal: (3,) unit normal of the plane, LiDAR frame.
            ring: (N,) of each return.
            noise: says how large they are.
        """
        up, left = noise.angle_sds(ring)
        columns, errors = angle_errors(
            up * (upward(self.points) @ normal) / self.sigma, left * (leftward(self.points) @ normal) / self.sigma, ring
        )
        return replace(self, errors=(*self.errors, *errors), bias=np.hstack([self.bias, columns]))

    def widened(self, noise: float, bias: float) -> PlaneReturns:
        """Return them with noise and biases that are so many times as large."""
        return replace(self, sigma=noise * self.sigma, bias=bias / noise * self.bias)


def returns_on_plane(
    scan: Scan, normal: Floats, distance: float, azimuth_noise: float = 0.0, options: PoseOptions = PoseOptions()
) -> PlaneReturns:
    """Set returns against a plane near the target's.

    Args:
        scan: the returns of one target; without rings, all have one bias. Its sensor has range noise and ring bias; an
            unknown one a centimetre each.
        normal: (3,) unit normal of the plane, LiDAR frame.
        distance: of the plane from the sensor along the normal, metres.
        azimuth_noise: standard deviation of one azimuth, rad.
        options: their flatness is that of the target.
    """
    points, sensor = scan.points, scan.sensor
    range_noise, ring_bias = 0.01, np.full(len(points), 0.01)
    if sensor is not None:
        known = scan.ring is not None and scan.ring.max(initial=0) < sensor.n_rings
        range_noise = sensor.range_noise
        ring_bias = sensor.range_bias_sds[scan.ring] if known else np.full(len(points), sensor.ring_bias)
    along = points @ normal
    cosine = np.abs(along) / np.linalg.norm(points, axis=1)
    turning = leftward(points)
    sideways = turning @ normal  # off the plane, metres per radian of azimuth
    sigma = np.sqrt((range_noise * cosine) ** 2 + (azimuth_noise * sideways) ** 2 + options.flatness**2)
    rings, column = np.unique(np.zeros(len(points), int) if scan.ring is None else scan.ring, return_inverse=True)
    bias = np.zeros((len(points), len(rings)))
    bias[np.arange(len(points)), column] = ring_bias * cosine / sigma
    errors = tuple(SharedError(RANGE_BIAS, ring=None if scan.ring is None else int(ring)) for ring in rings)
    in_plane = turning - points * (sideways / along)[:, None]
    coupling = azimuth_noise**2 * sideways[:, None] * in_plane
    return PlaneReturns(points * (distance / along)[:, None], distance - along, sigma, errors, bias, coupling)


def plane_measurement(returns: PlaneReturns) -> BiasedMeasurement:
    """Returns against the target's plane, before the errors that they share, in standard deviations, are marginalised.

    Where a residual and its row's coefficients err together, the gradient has a mean at the true pose, the sum of their
    covariances; the constants take it out.
    """
    normals = np.broadcast_to([1.0, 0.0, 0.0], returns.points.shape)
    A, r = template_rows(returns.points, normals, returns.offset)
    A, r = A / returns.sigma[:, None], r / returns.sigma
    mean, _ = template_rows(returns.coupling, normals, returns.offset)
    mean[:, 9:] = 0.0
    r = r - A @ np.linalg.lstsq(A.T @ A, (mean / returns.sigma[:, None] ** 2).sum(axis=0), rcond=1e-12)[0]
    return BiasedMeasurement.from_rows(A, returns.bias, r, np.eye(4), returns.errors)


def one_scan(shared: BiasedMeasurement) -> TemplateMeasurement:
    """Return the measurement of one scan alone, all errors that scans share marginalised."""
    return shared.marginal(1.0)


def angle_errors(by_elevation: Floats, by_azimuth: Floats, ring: Ints) -> tuple[Floats, tuple[SharedError, ...]]:
    """Return what errors of rings' elevations and azimuths do to rows, as columns (N, 2 R), and the errors (2 R,).

    Args:
        by_elevation: (N,) how far a standard deviation of its ring's elevation moves each row, in the rows' unit.
        by_azimuth: (N,) the same of its azimuth.
        ring: (N,) of each row.
    """
    rings, column = np.unique(ring, return_inverse=True)
    own = column[:, None] == np.arange(len(rings))
    columns = np.hstack([by_elevation[:, None] * own, by_azimuth[:, None] * own])
    return columns, tuple(SharedError(kind, ring=int(k)) for kind in (ELEVATION, AZIMUTH) for k in rings)
