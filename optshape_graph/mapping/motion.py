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

import gtsam
import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.pose import PoseEstimate, estimate_pose
from optshape_graph.scan import Scan
from optshape_graph.se3 import PoseLike, adjoint, as_matrix, inverse, log, skew
from optshape_graph.target import Target

MAX_ITERATIONS = 20
"""How often `solve_motion` makes its factors again at most."""

STALE_M = 1e-4
"""A measurement is made again with a new twist if that moves one of its returns by this, metres."""

SETTLING = 6
"""Iterations from which on a measurement may be twice as stale in each as in the one before."""

CONVERGED = 1e-7
"""Largest component of a step, rad or metres, with which it ends."""


def twist_between(T_a_b: PoseLike, seconds: float) -> Floats:
    """Return the constant twist (6,), rad/s and m/s, LiDAR frame, that makes a motion (4, 4) in some time."""
    return log(as_matrix(T_a_b)) / seconds


def deskew(scan: Scan, twist: Floats, at: float = 0.0) -> Scan:
    """Bring all returns to the LiDAR's frame at one time.

    Args:
        scan: with the time of each return.
        twist: (6,) constant, rotation first, rad/s and m/s, LiDAR frame.
        at: seconds, relative to the scan's stamp.

    Raises:
        InputError: the scan has no times.
    """
    return replace(scan, points=_moved(scan.points, _times(scan) - at, twist))


def estimate_moving(returns: Scan, target: Target, twist: Floats) -> tuple[PoseEstimate, float]:
    """Estimate a target's pose from returns taken while moving with a known twist.

    A target is hit within milliseconds, so its returns are brought to the mean of their own times: the rings stay what
    they are, and an error of the twist hardly matters there.

    Args:
        returns: on the target, with times.
        target: the template.
        twist: (6,) rotation first, rad/s and m/s, LiDAR frame.

    Returns:
        The estimate of T_lidar_target at a time, and that time, seconds, relative to the scan's stamp.

    Raises:
        InputError: the scan has no times.
        EstimationError: as `estimate_pose`.
    """
    if not len(returns):
        raise EstimationError(f"{returns.name}: no returns on the target")
    at = float(_times(returns).mean())
    return estimate_pose(deskew(returns, twist, at), target), at


@dataclass(frozen=True, eq=False)
class MotionMeasurement:
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
        if estimate.status == "failed":
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
    start, end, target = values.atPose3(k_start), values.atPose3(k_end), values.atPose3(k_target)
    T_start_end = start.between(end)
    xi, s = gtsam.Pose3.Logmap(T_start_end), measurement.fraction
    T_start_at = gtsam.Pose3.Expmap(s * xi)
    H = target.between(start.compose(T_start_at)).matrix()
    template = measurement.estimate.measurement
    by_H = template.jacobian(H)
    # Exp(s xi) moves by s J_r(s xi) dxi; X_e moves xi by J_r^-1(xi), and X_s by -J_r^-1(xi) Ad((X_s^-1 X_e)^-1).
    by_end = by_H @ (s * gtsam.Pose3.ExpmapDerivative(s * xi) @ gtsam.Pose3.LogmapDerivative(xi))
    by_start = by_H @ adjoint(inverse(T_start_at.matrix())) - by_end @ adjoint(inverse(T_start_end.matrix()))
    by_target = -by_H @ adjoint(inverse(H))
    unit = gtsam.noiseModel.Unit.Create(12)
    residual = template.residual(H)
    linear = gtsam.JacobianFactor(k_target, by_target, k_start, by_start, k_end, by_end, -residual, unit)
    at = gtsam.Values()
    for key, pose in ((k_target, target), (k_start, start), (k_end, end)):
        at.insert(key, pose)
    return gtsam.LinearContainerFactor(linear, at)


def solve_motion(
    measurements: Sequence[tuple[MotionMeasurement, int, int, int]],
    others: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
) -> tuple[gtsam.Values, gtsam.GaussianFactorGraph]:
    """Solve a graph with motion factors, made again in every iteration: Gauss-Newton.

    Args:
        measurements: each with the keys of the target and of the scan's start and end.
        others: what else there is: odometry, priors.
        values: initial.

    Returns:
        The solution, and the graph linearised there, of which marginals can be taken.

    Raises:
        EstimationError: the graph does not determine the variables, or it does not converge.
    """
    current = list(measurements)
    for iteration in range(MAX_ITERATIONS):
        # A ring end near a vertex may go from one edge to the other and back for ever: what is made again has to rest.
        stale = STALE_M * 2.0 ** max(0, iteration - SETTLING)
        graph = gtsam.NonlinearFactorGraph(others)
        for k, (measurement, k_target, k_start, k_end) in enumerate(current):
            motion = values.atPose3(k_start).between(values.atPose3(k_end)).matrix()
            again = measurement.with_twist(twist_between(motion, measurement.end - measurement.start), stale)
            current[k] = again, k_target, k_start, k_end
            graph.push_back(MotionFactor(again, k_target, k_start, k_end, values))
        linear = graph.linearize(values)
        try:
            step = linear.optimize()
        except RuntimeError as error:
            raise EstimationError(f"poses and targets are not determined: {error}") from error
        values = values.retract(step)
        if np.abs(step.vector()).max() < CONVERGED:
            return values, linear
    raise EstimationError(f"no convergence within {MAX_ITERATIONS} iterations")


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
