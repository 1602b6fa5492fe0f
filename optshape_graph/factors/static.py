"""Several scans of one static scene: range noise averages away, what the scans have in common does not.

A ring keeps its range bias from scan to scan. With biases beta (one per ring, or any other error that scans share),
a scan's whitened rows at the static pose H_hat are A z + B beta + r, and B says how far a unit of each bias moves each
residual there. Rows of several scans add up over [beta, z, 1] first; then beta is marginalised, once, under its prior:

    min over beta of 1/2 ||A z + B beta + r||^2 + 1/2 ||beta / sigma||^2,

which for one scan is the same as whitening its rows with the covariance I + B diag(sigma^2) B^T.

Whatever else scans have in common belongs in beta too: the inset along a ring, say, of a scanner that fires at the same
azimuths in every revolution. What measurements of *different* targets or placements share is left out, as if each had
been made with biases of its own.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, reduce
from operator import add

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats, Ints, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.factors._rows import checked, marginalised, root, triangular, triangular_by_parts
from optshape_graph.factors.measurement import TemplateMeasurement, substitution
from optshape_graph.se3 import adjoint, inverse, vec, vec_derivative
from optshape_graph.sensor import SensorModel, angle_sds, ring_trend


def ring_bias_columns(
    points: ArrayLike, normals: ArrayLike, ring: ArrayLike, n_rings: int, T_target_lidar: ArrayLike
) -> Floats:
    """Return B (N, R): how far a metre of each ring's range bias moves each residual n . (R p + t), unweighted.

    Args:
        points: (N, 3) metres, LiDAR frame; a biased range moves a point along its ray.
        normals: (N, 3) n of each row, target frame: (0, edge normal), or (1, 0, 0) for a row of the plane.
        ring: (N,) index of each point's ring, 0 to R - 1.
        n_rings: R, number of rings of the sensor.
        T_target_lidar: (4, 4) where the rows are linearised.

    Raises:
        InputError: shapes that do not fit, values that are not finite, or a ring that the sensor does not have.
    """
    p = checked("points", points, (-1, 3))
    n = checked("normals", normals, (len(p), 3))
    k = checked("ring", ring, (len(p),)).astype(int)
    if len(k) and (k.min() < 0 or k.max() >= n_rings):
        raise InputError(f"rings run from {k.min()} to {k.max()}; expected 0 to {n_rings - 1}")
    rays = p / np.linalg.norm(p, axis=1, keepdims=True)
    B = np.zeros((len(p), n_rings))
    B[np.arange(len(p)), k] = np.einsum("ni,ij,nj->n", n, np.asarray(T_target_lidar, float)[:3, :3], rays)
    return B


RANGE_BIAS, ELEVATION, AZIMUTH = "range bias", "elevation", "azimuth"
EDGE_OFFSET, OUTER_EDGE = "edge offset", "outer edge"
"""Kinds of errors of the sensor that the pose estimator knows: of rings' ranges, elevations and azimuths; of how far in
the returns at all edges lie; and of where between two rings the target ends."""

OF_RINGS = (RANGE_BIAS, ELEVATION, AZIMUTH)
"""Kinds of errors that a ring of a sensor keeps, in all scans of it."""

COMMON_RANGE, COMMON_ELEVATION, COMMON_AZIMUTH = "common range bias", "common elevation", "common azimuth"
RANGE_TREND, ELEVATION_TREND, AZIMUTH_TREND = "trend of range bias", "trend of elevation", "trend of azimuth"
OF_SENSOR = (COMMON_RANGE, COMMON_ELEVATION, COMMON_AZIMUTH, RANGE_TREND, ELEVATION_TREND, AZIMUTH_TREND, EDGE_OFFSET)
"""Kinds of errors that all rings of a sensor have in common, in all scans of it: the same for all, or growing with the
elevation."""

BRIGHTNESS, BLOOMING = "range bias by brightness", "blooming"
"""Kinds of errors that a surface's brightness makes: of all its ranges; and of how much further its rings reach."""

OF_RANGES = (RANGE_BIAS, COMMON_RANGE, RANGE_TREND, BRIGHTNESS)
"""Kinds of errors of ranges that many returns of a scan share."""

SURFACE = ("surface turned about y", "surface turned about z", "surface shifted along x")
STRAIN = ("aspect", "shear")
"""Kinds of errors that are the target's own, in all scans of it: that its surface is not the plane x = 0 of its frame,
and that its outline is not as drawn."""

OF_TARGET = (*SURFACE, *STRAIN)
"""Kinds of errors that a target keeps, in all scans of it."""


@dataclass(frozen=True)
class SharedError:
    """An error that several scans of one sensor have in common.

    Two are the same error exactly where they are equal.

    Attributes:
        kind: what it is, such as `RANGE_BIAS`.
        ring: the ring it belongs to, or None.
        band: the elevations, rad, lowest and highest, of the returns it belongs to, or None. With neither ring nor
            band, it belongs to all returns of a scan.
    """

    kind: str
    ring: int | None = None
    band: tuple[float, float] | None = None

    def __str__(self) -> str:
        if self.ring is not None:
            return f"{self.kind} of ring {self.ring}"
        if self.band is not None:
            low, high = np.degrees(self.band)
            return f"{self.kind} between {low:.3f} and {high:.3f} deg"
        return self.kind


@cache
def of_ring(kind: str, ring: int) -> SharedError:
    """Return the error of a kind that belongs to a ring: the same object always, for there are many, and but few."""
    return SharedError(kind, ring=ring)


@dataclass(frozen=True, eq=False, repr=False)
class BiasedMeasurement(Value):
    """The cost 1/2 ||S [beta; z; 1]||^2 of a target, beta being the errors that every scan of the scene shares.

    Scans of one static scene by one sensor add up (`+`) before `marginal` removes beta: equal errors are the same
    error, so scans need not have hit the target with the same rings.

    Attributes:
        stack: (n, n) S, whitened, upper triangular, n = k + 13.
        n_rows: number of scalar residuals it was made of.
        T_target_lidar: (4, 4) pose at which the columns of beta were linearised.
        shared: (k,) the shared errors, in the order of their columns.

    Raises:
        InputError: shapes that do not fit, values that are not finite, an error twice, or one that is no `SharedError`.
    """

    stack: Floats
    n_rows: int
    T_target_lidar: Floats
    shared: tuple[SharedError, ...]

    def __post_init__(self) -> None:
        n = len(self.stack)
        for error in self.shared:
            if not isinstance(error, SharedError):
                raise InputError(f"shared error {error!r}; expected a SharedError")
        if n < 13 or n != 13 + len(set(self.shared)):
            raise InputError(
                f"biased measurement of {n} columns; expected 13, and one for each of: {_words(self.shared)}"
            )
        object.__setattr__(self, "stack", frozen(checked("biased stack", self.stack, (n, n))))
        object.__setattr__(self, "T_target_lidar", frozen(checked("T_target_lidar", self.T_target_lidar, (4, 4))))

    @classmethod
    def from_rows(
        cls,
        A: ArrayLike,
        B: ArrayLike,
        r: ArrayLike,
        T_target_lidar: ArrayLike,
        shared: Sequence[SharedError] | None = None,
        n_rows: int | None = None,
    ) -> BiasedMeasurement:
        """Compress rows A z + B beta + r, whitened by what does *not* persist from scan to scan.

        Args:
            A: (m, 12) rows.
            B: (m, k) columns of the shared errors, such as `ring_bias_columns`, whitened as A is.
            r: (m,) constants, whitened as A is.
            T_target_lidar: (4, 4) pose of linearisation.
            shared: (k,) the shared errors; None: the range bias of ring 0, of ring 1, ..., a column for every ring.
            n_rows: number of residuals that the rows were made of; None: m.

        Raises:
            InputError: shapes that do not fit, values that are not finite, or an error twice.
        """
        rows = checked("rows", A, (-1, 12))
        columns = checked("bias columns", B, (len(rows), -1))
        stack = np.column_stack([columns, rows, checked("constants", r, (len(rows),))])
        errors = [SharedError(RANGE_BIAS, ring=i) for i in range(columns.shape[1])] if shared is None else shared
        m = len(rows) if n_rows is None else n_rows
        return cls(triangular_by_parts(stack, columns.shape[1]), m, np.asarray(T_target_lidar, float), tuple(errors))

    def __add__(self, other: BiasedMeasurement) -> BiasedMeasurement:
        """Return the measurement of both scans: the same beta, everything else independent.

        Raises:
            InputError: errors of one kind that belong to other things in either: bands of elevation that are not the
                same overlap, and rings with bands, so they are neither the same errors nor independent ones.
        """
        if not isinstance(other, BiasedMeasurement):
            return NotImplemented
        kinds = {error.kind for error in self.shared} & {error.kind for error in other.shared}
        for kind in {error.kind for error in self.shared + other.shared if error.ring is None} & kinds:
            mine, theirs = ({error for error in one.shared if error.kind == kind} for one in (self, other))
            if mine != theirs:
                raise InputError(
                    f"measurements whose shared errors mean different things do not add: {_words(mine - theirs)}; "
                    f"against {_words(theirs - mine)}: marginalise them in each scan first, with `without`"
                )
        place: dict[SharedError, int] = {}
        columns = [[place.setdefault(error, len(place)) for error in one.shared] for one in (self, other)]
        rows = np.zeros((len(self.stack) + len(other.stack), len(place) + 13))
        for one, own, part in zip((self, other), columns, np.split(rows, [len(self.stack)]), strict=True):
            part[:, [*own, *range(len(place), len(place) + 13)]] = one.stack
        stack = triangular_by_parts(rows, len(place))
        return BiasedMeasurement(stack, self.n_rows + other.n_rows, self.T_target_lidar, tuple(place))

    def without(self, errors: Collection[SharedError]) -> BiasedMeasurement:
        """Return the measurement with some errors marginalised, each in units of its standard deviation.

        Args:
            errors: that scans do not share after all; those that are not in it do not matter.
        """
        gone = [i for i, error in enumerate(self.shared) if error in errors]
        kept = [i for i, error in enumerate(self.shared) if error not in errors]
        g, k = len(gone), len(self.shared)
        ordered = self.stack[:, [*gone, *kept, *range(k, k + 13)]]
        R = triangular_by_parts(np.vstack([np.eye(g, k + 13), ordered]), k)
        return BiasedMeasurement(R[g:, g:], self.n_rows, self.T_target_lidar, tuple(self.shared[i] for i in kept))

    def rescaled(self, kind: str, factor: float) -> BiasedMeasurement:
        """Return the measurement with the unit of the shared errors of a kind so many times as large."""
        stack = self.stack.copy()
        stack[:, [i for i, error in enumerate(self.shared) if error.kind == kind]] *= factor
        return BiasedMeasurement(stack, self.n_rows, self.T_target_lidar, self.shared)

    def displaced(
        self, errors: Sequence[SharedError], effect: ArrayLike, T_target_lidar: ArrayLike
    ) -> BiasedMeasurement:
        """Return the measurement where further errors displace the pose, as a whole, in all scans alike.

        The minimum stays where it is; the pose's covariance grows by effect effect^T, however many scans are fused.

        Args:
            errors: (k,) what they are.
            effect: (6, k) right perturbation of T_lidar_target, rotation first, rad and metres, for a standard
                deviation of each.
            T_target_lidar: (4, 4) where the effects are linearised: at the minimum.
        """
        E, T = checked("effect", effect, (6, len(errors))), np.asarray(T_target_lidar, float)
        n = len(self.shared)
        # (T_lidar_target Exp(xi))^-1 = T_target_lidar Exp(-Ad(T_lidar_target) xi)
        columns = -self.stack[:, n : n + 12] @ vec_derivative(T) @ adjoint(inverse(T)) @ E
        stack = np.hstack([self.stack[:, :n], columns, self.stack[:, n:]])
        return BiasedMeasurement(triangular(stack), self.n_rows, self.T_target_lidar, (*self.shared, *errors))

    def loosened(self, covariance: ArrayLike) -> BiasedMeasurement:
        """Return the measurement of T_target_lidar with an error of its own behind it; see `TemplateMeasurement`.

        Args:
            covariance: (6, 6) of the error's tangent vector, rotation first.
        """
        moved = self.stack[:, len(self.shared) : -1] @ vec_derivative(self.T_target_lidar)
        columns = moved @ root(covariance)
        stack = marginalised(columns, self.stack)
        return BiasedMeasurement(stack, self.n_rows, self.T_target_lidar, self.shared)

    def substituted(self, T_target_a: ArrayLike, T_b_lidar: ArrayLike | None = None) -> BiasedMeasurement:
        """Return the measurement as one of T_a_b; see `TemplateMeasurement.substituted`."""
        k = len(self.shared)
        M = np.eye(k + 13)
        M[k:, k:] = substitution(T_target_a, T_b_lidar)
        A, B = np.asarray(T_target_a, float), np.eye(4) if T_b_lidar is None else np.asarray(T_b_lidar, float)
        pose = inverse(A) @ self.T_target_lidar @ inverse(B)
        return BiasedMeasurement(triangular(self.stack @ M), self.n_rows, pose, self.shared)

    def marginal(self, sigma: ArrayLike) -> TemplateMeasurement:
        """Return the measurement of the pose alone, beta marginalised under its prior.

        Args:
            sigma: standard deviation of the shared errors, one for all or (k,), in beta's units; 0: none.

        Raises:
            InputError: a standard deviation that is negative or not finite.
        """
        k = len(self.shared)
        sigmas = np.broadcast_to(np.asarray(sigma, float), (k,))
        if not (np.isfinite(sigmas).all() and (sigmas >= 0).all()):
            raise InputError(f"standard deviations of shared errors are {sigmas}; expected finite numbers >= 0")
        rows = marginalised(self.stack[:, :k] * sigmas, self.stack[:, k:])
        return TemplateMeasurement.from_stack(rows, self.n_rows, self.T_target_lidar)

    def of_one_scan(self) -> TemplateMeasurement:
        """Return the measurement of one scan alone: all errors are its own."""
        return self._of_one_scan

    @cached_property
    def _of_one_scan(self) -> TemplateMeasurement:
        return self.marginal(1.0)


def angle_entries(
    by_elevation: Floats, by_azimuth: Floats, ring: Ints, sensor: SensorModel | None
) -> tuple[Floats, Ints, tuple[SharedError, ...]]:
    """Return what errors of rings' elevations and azimuths do to rows: those that move each row, and the errors (K,).

    Args:
        by_elevation: (N,) how far each row moves with its ring's elevation, in the rows' unit per radian.
        by_azimuth: (N,) the same of its azimuth, in the rows' unit per radian.
        ring: (N,) of each row.
        sensor: says how large the errors are.

    Returns:
        How far a standard deviation of each moves the row, (N, J); which of the errors they are, (N, J); the errors.
    """
    rings, column = np.unique(ring, return_inverse=True)
    up, left = angle_sds(sensor, ring)
    moved, which = [up * by_elevation, left * by_azimuth], [column, len(rings) + column]
    errors = [of_ring(kind, k) for kind in (ELEVATION, AZIMUTH) for k in rings.tolist()]
    if sensor is not None:
        trend = ring_trend(sensor, ring)
        for kind, sd, by in (
            (COMMON_ELEVATION, sensor.common_elevation_sd, by_elevation),
            (COMMON_AZIMUTH, sensor.common_azimuth_sd, by_azimuth),
            (ELEVATION_TREND, sensor.elevation_trend_sd, trend * by_elevation),
            (AZIMUTH_TREND, sensor.azimuth_trend_sd, trend * by_azimuth),
        ):
            if sd > 0:
                moved.append(sd * by)
                which.append(np.full(len(ring), len(errors)))
                errors.append(SharedError(kind))
    return np.column_stack(moved), np.column_stack(which), tuple(errors)


def angle_errors(
    by_elevation: Floats, by_azimuth: Floats, ring: Ints, sensor: SensorModel | None
) -> tuple[Floats, tuple[SharedError, ...]]:
    """Return what `angle_entries` does as columns (N, K), a column for each error, and the errors (K,)."""
    moved, which, errors = angle_entries(by_elevation, by_azimuth, ring, sensor)
    return spread(moved, which, len(errors)), errors


def spread(moved: Floats, which: Ints, k: int) -> Floats:
    """Return columns (N, k) of entries (N, J) and the columns (N, J) that they belong to, each once in a row."""
    columns = np.zeros((len(moved), k))
    np.put_along_axis(columns, which, moved, axis=1)
    return columns


def fuse_static(measurements: Sequence[BiasedMeasurement], sigma: ArrayLike) -> TemplateMeasurement:
    """Fuse scans of one static scene: one target, one LiDAR, neither of which moved.

    However many scans there are, the result is no more certain than the shared errors allow. Elevations of rings that
    the scans show to be further off than their unit says are taken to be (`seen_scale`).

    Args:
        measurements: one for each scan, linearised at one pose.
        sigma: standard deviation of the shared errors, one for all or (k,) in the order in which they first occur, in
            their units.

    Raises:
        InputError: no measurement, shared errors that mean different things, or standard deviations that are none.
    """
    if not measurements:
        raise InputError("no measurement to fuse")
    total = reduce(add, measurements)
    return total.rescaled(ELEVATION, seen_scale(total, ELEVATION, sigma)).marginal(sigma)


SCALES = (1.0, 1.5, 2.0, 3.0)
"""How many times as large as stated errors may turn out to be."""


def seen_scale(total: BiasedMeasurement, kind: str, sigma: ArrayLike) -> float:
    """Return how many times as large as stated the errors of a kind are: the likeliest of `SCALES`, the pose unknown.

    The restricted likelihood of rows J x + B beta + r: its logarithm is that of 1 / det R, and half the square of what
    is left, R being the triangular factor of the rows under the prior of beta (Patterson and Thompson, Biometrika
    1971).

    Args:
        total: of all scans of a scene.
        kind: such as `ELEVATION`.
        sigma: standard deviation of the shared errors, one for all or (k,), in beta's units.
    """
    if not any(error.kind == kind for error in total.shared):
        return 1.0
    T, k = total.T_target_lidar, len(total.shared)
    A, sigmas = total.stack[:, k:-1], np.broadcast_to(np.asarray(sigma, float), (k,))
    moved, left = A @ vec_derivative(T), A @ vec(T) + total.stack[:, -1]
    cost = []
    for scale in SCALES:
        B = total.rescaled(kind, scale).stack[:, :k] * sigmas
        R = triangular(np.vstack([np.eye(k, k + 7), np.column_stack([B, moved, left])]))
        cost.append(float(np.log(np.abs(np.diag(R)[:-1]) + 1e-12).sum() + 0.5 * R[-1, -1] ** 2))
    return SCALES[int(np.argmin(cost))]


def _words(errors: Collection[SharedError]) -> str:
    """Name the first few."""
    names = [str(error) for error in errors]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
