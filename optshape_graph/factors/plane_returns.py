"""All returns of a target against its plane, with the noise and the biases of the sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.edges import leftward, upward
from optshape_graph.factors._rows import compressed
from optshape_graph.factors.measurement import FIRST_ROW
from optshape_graph.factors.static import (
    BRIGHTNESS,
    COMMON_RANGE,
    RANGE_BIAS,
    RANGE_TREND,
    BiasedMeasurement,
    SharedError,
    angle_entries,
    spread,
)
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel, ring_trend
from optshape_graph.target import FLATNESS


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
        errors: (K,) what the returns share, such as the range bias of each ring that hit the target.
        moved: (N, J) how far a standard deviation of each of the errors that move a residual does, in units of `sigma`.
        which: (N, J) which of the errors these are.
        coupling: (N, 3) covariance of each residual with its p, square metres: an azimuth error moves both.
    """

    points: Floats
    offset: Floats
    sigma: Floats
    errors: tuple[SharedError, ...]
    moved: Floats
    which: Ints
    coupling: Floats

    def select(self, mask: Bools) -> PlaneReturns:
        """Return some of them, of a mask (N,)."""
        names = ("points", "offset", "sigma", "moved", "which", "coupling")
        return replace(self, **{name: getattr(self, name)[mask] for name in names})

    def sharing(self, errors: Sequence[SharedError], moved: Floats, which: Ints | None = None) -> PlaneReturns:
        """Return them with further errors that they share.

        Args:
            errors: (L,) what they are.
            moved: (N, I) how far a standard deviation of those that move a residual does, in units of `sigma`.
            which: (N, I) which of the errors these are; None: all move every residual, in their order.
        """
        which = np.broadcast_to(np.arange(len(errors)), moved.shape) if which is None else which
        return replace(
            self,
            errors=(*self.errors, *errors),
            moved=np.hstack([self.moved, moved]),
            which=np.hstack([self.which, len(self.errors) + which]),
        )

    def with_angles(self, normal: Floats, ring: Ints, sensor: SensorModel | None) -> PlaneReturns:
        """Return them with errors of each ring's elevation and azimuth, and of what all ranges share.

        Args:
            normal: (3,) unit normal of the plane, LiDAR frame.
            ring: (N,) of each return.
            sensor: says how large they are.
        """
        moved, which, errors = angle_entries(
            upward(self.points) @ normal / self.sigma, leftward(self.points) @ normal / self.sigma, ring, sensor
        )
        found = self.sharing(errors, moved, which)
        if sensor is not None and sensor.common_range_sd > 0:
            found = found.sharing([SharedError(COMMON_RANGE)], self._by_ranges(normal, sensor.common_range_sd))
        if sensor is not None and sensor.range_trend_sd > 0:
            by_trend = self._by_ranges(normal, sensor.range_trend_sd * ring_trend(sensor, ring))
            found = found.sharing([SharedError(RANGE_TREND)], by_trend)
        return found

    def _by_ranges(self, normal: Floats, sigma: float | Floats) -> Floats:
        """(N, 1) how far an error of all ranges, of a standard deviation in metres, moves each residual."""
        cosine = np.abs(self.points @ normal) / np.linalg.norm(self.points, axis=1)
        return np.asarray(sigma * cosine / self.sigma)[:, None]

    def with_brightness(self, normal: Floats, sigma: float) -> PlaneReturns:
        """Return them with a range bias that all share, of a standard deviation in metres.

        Args:
            normal: (3,) unit normal of the plane, LiDAR frame.
            sigma: metres.
        """
        return self.sharing([SharedError(BRIGHTNESS)], self._by_ranges(normal, sigma))

    def with_bands(self, points: Floats, counts: Sequence[int]) -> PlaneReturns:
        """Return them with range biases at several scales.

        Lasers, each with a range bias, are not told apart in a cloud without rings, and a bias may drift with the
        direction: beside one for all, bands of elevation, broad and narrow, stand for them. One scale alone would take
        the slopes within its bands, or those between them, for certain.

        Args:
            points: (N, 3) the returns, metres, LiDAR frame.
            counts: number of bands at each scale.
        """
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        lowest, extent = float(elevation.min()), max(float(np.ptp(elevation)), 1e-9)
        found = self
        for count in counts:
            bands, which = np.unique(elevation_bands(points, count), return_inverse=True)
            limits = lowest + extent * np.column_stack([bands, bands + 1]) / count
            errors = [SharedError(RANGE_BIAS, band=(low, high)) for low, high in limits.tolist()]
            found = found.sharing(errors, self.moved / np.sqrt(len(counts)), which[:, None])
        return found

    def widened(self, noise: float, bias: float) -> PlaneReturns:
        """Return them with noise and biases that are so many times as large."""
        return replace(self, sigma=noise * self.sigma, moved=bias / noise * self.moved)


def elevation_bands(points: Floats, count: int) -> Ints:
    """(N,) band of elevation of each of points (N, 3), metres, of `count` that are equally wide."""
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    fraction = (elevation - elevation.min()) / max(float(np.ptp(elevation)), 1e-9)
    return np.asarray(np.minimum((fraction * count).astype(np.int64), count - 1))


def returns_on_plane(
    scan: Scan, normal: Floats, distance: float, azimuth_noise: float = 0.0, flatness: float = FLATNESS
) -> PlaneReturns:
    """Set returns against a plane near the target's.

    Args:
        scan: the returns of one target; without rings, all have one bias. Its sensor has range noise and ring bias; an
            unknown one a centimetre each.
        normal: (3,) unit normal of the plane, LiDAR frame.
        distance: of the plane from the sensor along the normal, metres.
        azimuth_noise: standard deviation of one azimuth, rad.
        flatness: standard deviation of the target itself about its plane, metres.
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
    sigma = np.sqrt((range_noise * cosine) ** 2 + (azimuth_noise * sideways) ** 2 + flatness**2)
    rings, column = np.unique(np.zeros(len(points), int) if scan.ring is None else scan.ring, return_inverse=True)
    moved = (ring_bias * cosine / sigma)[:, None]
    errors = tuple(SharedError(RANGE_BIAS, ring=None if scan.ring is None else int(ring)) for ring in rings)
    in_plane = turning - points * (sideways / along)[:, None]
    coupling = azimuth_noise**2 * sideways[:, None] * in_plane
    projected = points * (distance / along)[:, None]
    return PlaneReturns(projected, distance - along, sigma, errors, moved, column[:, None], coupling)


def plane_measurement(returns: PlaneReturns) -> BiasedMeasurement:
    """Returns against the target's plane, before the errors that they share, in standard deviations, are marginalised.

    Where a residual and its row's coefficients err together, the gradient has a mean at the true pose, the sum of their
    covariances; the constants take it out.
    """
    sigma, k = returns.sigma[:, None], returns.which.shape[1]
    A = np.column_stack([returns.points / sigma, 1 / sigma])  # linear in the first row of [R t]
    mean = np.append((returns.coupling / sigma**2).sum(axis=0), 0.0)
    r = -returns.offset / returns.sigma - A @ np.linalg.lstsq(A.T @ A, mean, rcond=1e-12)[0]
    rows, which = compressed(np.column_stack([returns.moved, A, r]), returns.which)
    pose = np.zeros((len(rows), 12))
    pose[:, FIRST_ROW] = rows[:, k:-1]
    columns = spread(rows[:, :k], which, len(returns.errors))
    return BiasedMeasurement.from_rows(
        pose, columns, rows[:, -1], np.eye(4), returns.errors, n_rows=len(returns.points)
    )
