"""Scans taken while moving: every ray is fired from a pose of its own.

Between the poses X_s at a scan's start and X_e at its end the twist is constant: X(s) = X_s Exp(s xi), xi =
Log(X_s^-1 X_e), s from 0 to 1. A target is hit within a few milliseconds. Each of its returns is brought from its own
time to their mean time, which makes a template measurement of the target's pose at that time: one that holds at the
twist it was made with, and is made again when the twist has changed. The measurement's pose is then X(s), which
`MotionFactor` links to both ends of the scan, so that the twist is estimated with everything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import is_

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.graph import Chains, Inverse, Solution, State, add_rows, solve
from optshape_graph.mapping.sweep import Sweep
from optshape_graph.pose import PoseEstimate, estimate_pose
from optshape_graph.scan import Scan
from optshape_graph.se3 import (
    PoseLike,
    adjoint,
    as_matrix,
    exp,
    inverse,
    inverse_right_jacobian,
    log,
    right_jacobian,
    skew,
)
from optshape_graph.target import Target

MAX_ITERATIONS = 20
"""How often `solve_motion` makes its measurements again at most."""

STALE_M = 1e-4
"""A measurement is made again with a new twist if that moves one of its returns by this, metres."""

SETTLING = 6
"""After this many times the allowed staleness of a measurement doubles each time."""


def twist_between(T_a_b: PoseLike, seconds: float) -> Floats:
    """Return the constant twist (6,), rad/s and m/s, LiDAR frame, that makes a motion (4, 4) in some time."""
    return log(as_matrix(T_a_b)) / seconds


def deskew(scan: Scan, motion: Floats | Sweep, at: float = 0.0) -> Scan:
    """Bring all returns to the LiDAR's frame at one time.

    Args:
        scan: with the time of each return.
        motion: of the LiDAR: a constant twist (6,), rotation first, rad/s and m/s, in its own frame; or a `Sweep`.
        at: seconds, relative to the scan's stamp.

    Raises:
        InputError: the scan has no times.
    """
    return replace(scan, points=_brought(scan.points, _times(scan), motion, at))


def estimate_moving(returns: Scan, target: Target, motion: Floats | Sweep) -> tuple[PoseEstimate, float]:
    """Estimate a target's pose from returns taken while moving in a known way.

    A target is hit within milliseconds, so its returns are brought to the mean of their own times: the rings stay what
    they are, and an error of the motion hardly matters there.

    Args:
        returns: on the target, with times.
        target: the template.
        motion: a twist (6,), rad/s and m/s, or a sweep, as of `deskew`.

    Returns:
        The estimate of T_lidar_target at a time, and that time, seconds, relative to the scan's stamp.

    Raises:
        InputError: the scan has no times.
        EstimationError: as `estimate_pose`.
    """
    straight, at = at_own_time(returns, np.arange(len(returns)), motion)
    return estimate_pose(straight, target), at


def at_own_time(scan: Scan, rows: Ints, motion: Floats | Sweep) -> tuple[Scan, float]:
    """Bring a scan's returns on one target to the mean of their times; return that, too, seconds from the stamp.

    Args:
        scan: with the time of each return.
        rows: (K,) numbers of the target's returns.
        motion: a twist (6,), rad/s and m/s, or a sweep, as of `deskew`.

    Raises:
        InputError: the scan has no times.
    """
    seconds = _times(scan)[rows]
    at = float(seconds.mean()) if len(rows) else 0.0
    return scan.select(rows, _brought(scan.points.take(rows, axis=0), seconds, motion, at)), at


def _brought(points: Floats, seconds: Floats, motion: Floats | Sweep, at: float) -> Floats:
    """Return points (N, 3), metres, each hit at its own time (N,), seconds, in the LiDAR's frame at another time."""
    if isinstance(motion, Sweep):
        return motion.straighten(points, seconds, at)
    return _moved(points, seconds - at, motion)


@dataclass(frozen=True, eq=False, repr=False)
class MotionMeasurement(Value):
    """One target in one scan taken while moving, measured at one twist.

    Attributes:
        returns: on the target, as measured, with times.
        start, end: of the scan, seconds, relative to its stamp.
        at: mean time of the returns, seconds, relative to the stamp.
        twist: (6,) rad/s and m/s, LiDAR frame, that the returns were brought to that time with.
        estimate: of T_lidar_target at that time.
    """

    returns: Scan
    start: float
    end: float
    at: float
    twist: Floats
    estimate: PoseEstimate

    @classmethod
    def of(cls, returns: Scan, target: Target, twist: Floats, start: float, end: float) -> MotionMeasurement:
        """Measure a target with a first guess of the twist.

        Args:
            returns: on the target, with times.
            target: the template.
            twist: (6,) rotation first, rad/s and m/s, LiDAR frame.
            start: of the scan, seconds, relative to its stamp.
            end: of the scan.

        Raises:
            InputError: the scan has no times, or ends before it starts.
            EstimationError: the returns determine no pose.
        """
        if not end > start:
            raise InputError(f"{returns.name}: the scan ends at {end} s, which is not after its start at {start} s")
        estimate, at = estimate_moving(returns, target, twist)
        if not estimate.usable:
            raise EstimationError(f"{returns.name}: {estimate.reason}")
        return cls(returns, start, end, at, np.asarray(twist, float), estimate)

    @property
    def fraction(self) -> float:
        """Time of the measurement, from 0 at the scan's start to 1 at its end."""
        return (self.at - self.start) / (self.end - self.start)

    def with_twist(self, twist: Floats, stale: float = STALE_M) -> MotionMeasurement:
        """Return the measurement made with another twist; this one, if no return would move by more than `stale`.

        Args:
            twist: (6,) of the LiDAR in its own frame, rad/s, then m/s.
            stale: metres.

        Raises:
            InputError: the returns have no times.
        """
        change = np.abs(np.asarray(twist, float) - self.twist)
        apart = float(np.abs(_times(self.returns) - self.at).max())
        reach = float(np.linalg.norm(self.returns.points, axis=1).max())
        if apart * (np.linalg.norm(change[:3]) * reach + np.linalg.norm(change[3:])) <= stale:
            return self
        return self.of(self.returns, self.estimate.target, twist, self.start, self.end)


@dataclass(frozen=True, eq=False, repr=False)
class Moving(Value):
    """Measurements taken while moving, as a term: each of H = T_target_world X_s Exp(s xi), xi = Log(X_s^-1 X_e).

    Attributes:
        measurements: of one target in one scan each.
        ends: X_s^-1 X_e, the motion within each scan.
        chains: T_target_world X_s.
        keys: of T_world_target, and of T_world_lidar at the scan's start and at its end, of each measurement.
    """

    measurements: tuple[MotionMeasurement, ...]
    ends: Chains
    chains: Chains
    keys: tuple[tuple[int, int, int], ...]

    @classmethod
    def of(cls, measurements: Sequence[tuple[MotionMeasurement, int, int, int]]) -> Moving:
        """Return the term of measurements, each with the keys of the target and of the scan's start and end."""
        keys = tuple((target, start, end) for _, target, start, end in measurements)
        return cls(
            tuple(measurement for measurement, *_ in measurements),
            Chains([[Inverse(start), end] for _, start, end in keys]),
            Chains([[Inverse(target), start] for target, start, _ in keys]),
            keys,
        )

    def motions(self, state: State) -> Floats:
        """Return the motion (m, 4, 4) within each scan."""
        return self.ends.at(state)

    def at(self, state: State) -> MovingModel:
        """Return residuals and derivatives at a state."""
        s = np.array([measurement.fraction for measurement in self.measurements])
        ends = self.ends.at(state)
        xi = log(ends)
        T_start_at = exp(s[:, None] * xi)
        H = self.chains.at(state) @ T_start_at
        templates = [measurement.estimate.measurement for measurement in self.measurements]
        residual = np.array([template.residual(T) for template, T in zip(templates, H, strict=True)])
        by_H = np.array([template.jacobian(T) for template, T in zip(templates, H, strict=True)])
        # Exp(s xi) moves by s J_r(s xi) dxi; X_e moves xi by J_r^-1(xi), and X_s by -J_r^-1(xi) Ad((X_s^-1 X_e)^-1).
        by_end = by_H @ (s[:, None, None] * right_jacobian(s[:, None] * xi) @ inverse_right_jacobian(xi))
        by_start = by_H @ adjoint(inverse(T_start_at)) - by_end @ adjoint(inverse(ends))
        by_target = -by_H @ adjoint(inverse(H))
        floor = sum(template.c**2 for template in templates)
        return MovingModel(self.keys, residual, (by_target, by_start, by_end), floor)


@dataclass(frozen=True, eq=False, repr=False)
class MovingModel(Value):
    """Residuals of measurements taken while moving, and their derivatives, at a state.

    Attributes:
        keys: of each measurement's target, start and end.
        residual: (m, 12) whitened.
        by: (m, 12, 6) rows by the target, by the start and by the end.
        floor: chi-square that no pose takes away.
    """

    keys: tuple[tuple[int, int, int], ...]
    residual: Floats
    by: tuple[Floats, Floats, Floats]
    floor: float

    @property
    def error(self) -> float:
        """Half the chi-square."""
        return 0.5 * float(np.square(self.residual).sum()) + 0.5 * self.floor

    def add_to(self, linear: gtsam.GaussianFactorGraph) -> None:
        """Add the linearisation to a graph."""
        for keys, r, *blocks in zip(self.keys, self.residual, *self.by, strict=True):
            add_rows(linear, keys, blocks, -r)


def MotionFactor(
    measurement: MotionMeasurement, k_target: int, k_start: int, k_end: int, values: gtsam.Values
) -> gtsam.LinearContainerFactor:
    """Return the factor between T_world_target and the LiDAR's poses at the scan's start and end, linear at `values`.

    The residual is the template measurement's, of H = T_world_target^-1 X_s Exp(s xi), xi = Log(X_s^-1 X_e).

    Args:
        measurement: of one target in the scan.
        k_target: key of T_world_target.
        k_start: key of T_world_lidar at the scan's start.
        k_end: key of T_world_lidar at its end.
        values: where to linearise; make the factor again when they have changed.
    """
    at, linear = gtsam.Values(), gtsam.GaussianFactorGraph()
    for key in (k_target, k_start, k_end):
        at.insert(key, values.atPose3(key))
    Moving.of([(measurement, k_target, k_start, k_end)]).at(State.of(at)).add_to(linear)
    return gtsam.LinearContainerFactor(linear.at(0), at)


def solve_motion(
    measurements: Sequence[tuple[MotionMeasurement, int, int, int]],
    others: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
) -> Solution:
    """Solve a graph with measurements taken while moving, made again with the twist found until they stay the same.

    Args:
        measurements: each with the keys of the target and of the scan's start and end.
        others: what else there is: odometry, priors.
        values: initial.

    Raises:
        EstimationError: a measurement can't be made with the twist found, or they don't come to rest.
    """
    term = Moving.of(measurements)
    solution: Solution | None = None
    for iteration in range(MAX_ITERATIONS):
        # A ring end near a vertex may go from one edge to the other and back for ever: what is made again has to rest.
        stale = STALE_M * 2.0 ** max(0, iteration - SETTLING)
        again = tuple(
            measurement.with_twist(twist_between(motion, measurement.end - measurement.start), stale)
            for measurement, motion in zip(term.measurements, term.motions(State.of(values)), strict=True)
        )
        if solution is not None and all(map(is_, again, term.measurements)):
            return solution
        term = replace(term, measurements=again)
        solution = solve(values, [term], others)
        values = solution.values
    raise EstimationError(f"measurements are still made again after {MAX_ITERATIONS} times")


def _times(scan: Scan) -> Floats:
    if scan.time is None:
        raise InputError(f"{scan.name}: returns have no times; without them a moving scan cannot be set right")
    return scan.time


def _moved(points: Floats, seconds: Floats, twist: Floats) -> Floats:
    """Exp(s twist) p of points (N, 3), each at its own s (N,), in closed form: one axis turns them all.

    With k the axis, w the rate of turning, K = [k]x and v the velocity, it is
    p + sin(w s) (K p - K K v / w) + (1 - cos(w s)) (K K p + K v / w) + s (v + K K v).
    """
    rate, v = float(np.linalg.norm(twist[:3])), twist[3:]
    if rate < 1e-12:
        return points + np.outer(seconds, v)
    K = skew(twist[:3] / rate)
    KK, angle = K @ K, rate * seconds
    turned = np.sin(angle)[:, None] * (points @ K.T - KK @ v / rate)
    turned += (2.0 * np.sin(0.5 * angle) ** 2)[:, None] * (points @ KK.T + K @ v / rate)
    turned += np.outer(seconds, v + KK @ v)
    turned += points
    return np.asarray(turned)
