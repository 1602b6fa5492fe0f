"""All returns of a target against its plane, with the noise and the biases of the sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.edges import leftward, upward
from optshape_graph.factors._rows import factored, triangular
from optshape_graph.factors.measurement import FIRST_ROW
from optshape_graph.factors.static import (
    BRIGHTNESS,
    COMMON_RANGE,
    RANGE_BIAS,
    RANGE_TREND,
    BiasedMeasurement,
    SharedError,
    angle_entries,
    of_ring,
)
from optshape_graph.groups import Groups
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

    def select(self, rows: Bools | Ints) -> PlaneReturns:
        """Return some of them, by a mask (N,) or by numbers (M,)."""
        names = ("points", "offset", "sigma", "moved", "which", "coupling")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

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
    (found,) = returns_on_planes([scan], normal[None], np.array([distance]), np.array([azimuth_noise]), flatness)
    return found


def returns_on_planes(
    scans: Sequence[Scan], normals: Floats, distances: Floats, azimuth_noise: Floats, flatness: float
) -> list[PlaneReturns]:
    """Set the returns of B scans against a plane each, as `returns_on_plane` does.

    Args:
        scans: (B,) the returns of one target each.
        normals: (B, 3) unit normals of the planes, LiDAR frame.
        distances: (B,) of the planes from the sensor along their normals, metres.
        azimuth_noise: (B,) standard deviations of one azimuth, rad.
        flatness: standard deviation of the targets themselves about their planes, metres.
    """
    of = Groups.of([scan.points for scan in scans])
    points, normal, distance = np.concatenate([scan.points for scan in scans]), of.each(normals), of.each(distances)
    range_noise = of.each(np.array([scan.sensor.range_noise if scan.sensor else 0.01 for scan in scans]))
    range_bias = np.concatenate([_range_biases(scan) for scan in scans])
    along = np.einsum("ij,ij->i", points, normal)
    cosine = np.abs(along) / np.sqrt(np.einsum("ij,ij->i", points, points))
    turning = leftward(points)
    sideways = np.einsum("ij,ij->i", turning, normal)  # off the plane, metres per radian of azimuth
    azimuth_noise = of.each(azimuth_noise)
    sigma = np.sqrt((range_noise * cosine) ** 2 + (azimuth_noise * sideways) ** 2 + flatness**2)
    moved = (range_bias * cosine / sigma)[:, None]
    in_plane = turning - points * (sideways / along)[:, None]
    coupling = (azimuth_noise**2 * sideways)[:, None] * in_plane
    projected, offset = points * (distance / along)[:, None], distance - along
    found = []
    for scan, rows in zip(scans, of.slices, strict=True):
        rings, column = np.unique(np.zeros(len(scan), int) if scan.ring is None else scan.ring, return_inverse=True)
        errors = (
            [SharedError(RANGE_BIAS)] if scan.ring is None else [of_ring(RANGE_BIAS, ring) for ring in rings.tolist()]
        )
        found.append(
            PlaneReturns(
                projected[rows], offset[rows], sigma[rows], tuple(errors), moved[rows], column[:, None], coupling[rows]
            )
        )
    return found


def _range_biases(scan: Scan) -> Floats:
    """(N,) standard deviation of the range bias of each return's ring, metres."""
    sensor = scan.sensor
    if sensor is None or scan.ring is None:
        return np.full(len(scan), sensor.ring_bias if sensor else 0.01)
    return sensor.range_bias_sds[scan.ring]


def plane_measurement(returns: PlaneReturns) -> BiasedMeasurement:
    """Set returns against the target's plane, before the errors that they share are marginalised.

    Errors are in standard deviations. Where a residual and its row's coefficients err together, the gradient has a mean
    at the true pose, the sum of their covariances; the constants take it out.

    Returns that the same errors move, such as those of a ring, are a group. Each group's rows are reduced by
    themselves, and those with an error of that group alone are final: what is left of all groups has the other errors
    and four entries of the pose. So the work grows with the returns (block-angular least squares; Golub and Plemmons,
    Linear Algebra Appl. 1980).
    """
    sigma, k, j = returns.sigma[:, None], len(returns.errors), returns.which.shape[1]
    A = np.column_stack([returns.points / sigma, 1 / sigma])  # linear in the first row of [R t]
    r = -returns.offset / returns.sigma
    if returns.coupling.any():
        mean = np.append((returns.coupling / sigma**2).sum(axis=0), 0.0)
        r = r - A @ np.linalg.lstsq(A.T @ A, mean, rcond=1e-12)[0]
    order = np.lexsort(returns.which.T[::-1])
    which = returns.which[order]
    first = np.flatnonzero(np.append(True, (which[1:] != which[:-1]).any(axis=1)))
    groups, which = Groups(np.diff(first, append=len(which))), which[first]
    own = (np.bincount(which.ravel(), minlength=k)[which] == 1).all(axis=0)
    place = np.argsort(~own, kind="stable")  # errors of one group alone first
    own, which = int(np.count_nonzero(own)), which[:, place]
    rows = np.zeros((len(groups), groups.counts.max(), j + 5))
    rank = np.arange(len(order)) - groups.each(groups.first)
    rows[groups.of_row, rank] = np.column_stack([returns.moved[:, place], A, r])[order]

    # Reduced group by group, and at last what is left of all.
    R = factored(rows)
    columns = np.column_stack([which, np.broadcast_to(k + np.arange(5), (len(which), 5))])
    common = np.ones(k + 5, dtype=bool)
    common[which[:, :own]] = False
    whole, final, left = np.zeros((k + 5, k + 5)), R[:, :own], R[:, own:, own:]
    whole[columns[:, : final.shape[1], None], columns[:, None]] = final
    rest = np.zeros((*left.shape[:2], np.count_nonzero(common)))
    np.put_along_axis(rest, np.broadcast_to((np.cumsum(common) - 1)[columns[:, None, own:]], left.shape), left, axis=2)
    whole[np.ix_(common, common)] = triangular(rest.reshape(-1, rest.shape[2]))
    stack, place = np.zeros((k + 13, k + 13)), np.concatenate([np.arange(k), k + np.array([*FIRST_ROW, 12])])
    stack[np.ix_(place, place)] = whole
    return BiasedMeasurement(stack, len(returns.points), np.eye(4), returns.errors)
