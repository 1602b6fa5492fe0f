"""How a LiDAR moves while it scans: a smooth motion through the odometry about the scan, and how well that is known.

With T a pose of the odometry near the scan's stamp, poses about it are T Exp(xi(s)), s being seconds from the stamp. xi
is a polynomial of second degree, fitted by least squares: the mean of many poses is better known than any of them, and
the velocity of the fit far better than the difference of two neighbours. What the poses of many scans scatter about
their fits is the odometry's jitter, from which follows how well a motion within a scan is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.se3 import difference, exp, inverse

DEGREE = 2
"""Of the polynomials: a tenth of a second of anything on wheels, legs or wings."""


@dataclass(frozen=True)
class MotionNoise:
    """Standard deviations of odometry: what it drifts by, each axis, per square root of what it has gone.

    Attributes:
        metres: per square root of a metre, metres.
        radians: per square root of a metre, rad.
        metres_at_rest: per square root of a second, metres.
        radians_at_rest: per square root of a second, rad.
    """

    metres: float = 0.02
    radians: float = np.radians(0.2)
    metres_at_rest: float = 0.005
    radians_at_rest: float = np.radians(0.1)

    def covariance(self, distance: float, seconds: float) -> Floats:
        """(6, 6) of a motion over a distance, metres, and a time, rotation first."""
        rotation = self.radians**2 * distance + self.radians_at_rest**2 * seconds
        translation = self.metres**2 * distance + self.metres_at_rest**2 * seconds
        return np.diag([rotation] * 3 + [translation] * 3)


@dataclass(frozen=True, eq=False)
class Sweep:
    """The motion of a LiDAR about one scan: T_odometry_lidar at s seconds from its stamp is T Exp(xi(s)).

    Attributes:
        T: (4, 4) pose that the polynomial is about.
        coefficients: (k, 6) of xi in powers of s, rotation first, rad and metres.
        covariance: (k, k) matrix of the coefficients, in units of the jitter's variance.
        jitter: standard deviations of single poses about the motion: rad, and metres.
        drift: what odometry drifts by; None: not at all.
        misfit: (2,) squared residuals of the fit, rad2 and m2.
        freedom: number of poses beyond those that a fit needs.
        clock_sd: standard deviation of the poses' stamps against those of the scans, seconds.
    """

    T: Floats
    coefficients: Floats
    covariance: Floats
    jitter: tuple[float, float] = (0.0, 0.0)
    drift: MotionNoise | None = None
    misfit: tuple[float, float] = (0.0, 0.0)
    freedom: int = 0
    clock_sd: float = 0.0

    @classmethod
    def fit(cls, seconds: Sequence[float], poses: Sequence[Floats]) -> Sweep:
        """Fit the motion to poses T_odometry_lidar.

        Args:
            seconds: (n,) of the poses, from the scan's stamp; two of them at least.
            poses: (n, 4, 4) of the LiDAR.
        """
        s, T = np.asarray(seconds, float), np.asarray(poses, float)
        middle = T[np.abs(s).argmin()]
        xi = difference(middle, T)
        powers = s[:, None] ** np.arange(min(DEGREE, len(s) - 1) + 1)
        coefficients: Floats = np.asarray(np.linalg.lstsq(powers, xi)[0], np.float64)
        residual = xi - powers @ coefficients
        covariance: Floats = np.asarray(np.linalg.inv(powers.T @ powers), np.float64)
        misfit = float(np.square(residual[:, :3]).sum()), float(np.square(residual[:, 3:]).sum())
        return cls(middle, coefficients, covariance, misfit=misfit, freedom=len(s) - powers.shape[1])

    @property
    def twist(self) -> Floats:
        """(6,) at the stamp, rotation first, rad/s and m/s: how xi changes."""
        return np.asarray(self.coefficients[1] if len(self.coefficients) > 1 else np.zeros(6))

    @property
    def T_odometry_lidar(self) -> Floats:
        """(4, 4) at the stamp."""
        return np.asarray(self.T @ exp(self.coefficients[0]))

    def between(self, a: float, b: Floats | float) -> Floats:
        """Return T_a_b (..., 4, 4): the LiDAR at b (...) in its frame at a, seconds from the stamp."""
        return np.asarray(inverse(exp(self._xi(np.asarray(a)))) @ exp(self._xi(np.asarray(b, float))))

    def uncertainty(self, a: float, b: float) -> Floats:
        """Return the covariance (6, 6) of a motion's right perturbation, from a to b, rotation first.

        It is that of the fit, by the poses' jitter, what the odometry drifts by in between, and what the LiDAR moves by
        in the time by which the clocks may differ.
        """
        step = self._powers(np.asarray(b)) - self._powers(np.asarray(a))
        covariance = np.diag(float(step @ self.covariance @ step) * np.square(np.repeat(self.jitter, 3)))
        covariance += self.clock_sd**2 * np.outer(self.twist, self.twist)
        if self.drift is None:
            return covariance
        return covariance + self.drift.covariance(float(np.linalg.norm(self.twist[3:])) * abs(b - a), abs(b - a))

    def straighten(self, points: Floats, seconds: Floats, at: float) -> Floats:
        """Return points (N, 3), metres, each hit at its own time (N,), s, in the LiDAR's frame at another time."""
        times, which = np.unique(seconds, return_inverse=True)
        x, y, z = points.T
        straight = np.empty_like(points)
        for axis, (to_x, to_y, to_z, t) in enumerate(self.between(at, times)[:, :3].transpose(1, 2, 0)):
            straight[:, axis] = to_x[which] * x + to_y[which] * y + to_z[which] * z + t[which]
        return straight

    def _powers(self, s: Floats) -> Floats:
        return np.asarray(s[..., None] ** np.arange(len(self.coefficients)))

    def _xi(self, s: Floats) -> Floats:
        return np.asarray(self._powers(s) @ self.coefficients)
