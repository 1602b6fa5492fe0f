"""Calibration of a LiDAR to motion capture, with scans and markers in one graph.

Unknowns of a session: T_lidar_mocap; the marker layout, a point near each vertex in the target frame; and the target's
pose in every scan. Each scan's returns constrain its pose through the exact template factor, its markers through the
layout and T_lidar_mocap. The layout has a prior at the vertices: it alone tells a displacement of all markers from one
of the frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E, H, M, S

from optshape_graph._arrays import Floats
from optshape_graph.calibration.mocap.comparison import MocapScan, ScanError, in_sample, leave_one_out, name_alike, tie
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.factors import CheckedFactor, TemplateFactor
from optshape_graph.pose import refine
from optshape_graph.se3 import inverse, inverse_covariance, skew

MARKER_NOISE = 1e-3
"""Standard deviation of a marker coordinate, metres: motion capture measures to a millimetre or better."""

LAYOUT_PRIOR = 0.03
"""Standard deviation of a marker's place about its vertex, metres."""

SCALE_PRIOR = 0.05
"""Standard deviation of the motion capture's scale about 1, where it is estimated."""


@dataclass(frozen=True, eq=False)
class MocapCalibration:
    """A LiDAR tied to motion capture.

    Attributes:
        T_lidar_mocap: (4, 4).
        covariance: (6, 6) of its right perturbation: rotation first, motion-capture frame. Widened where the scans
            scatter more than they should.
        marker_layout: (n, 3) markers, target frame, metres.
        layout_sigma: (n, 3) their standard deviations, metres.
        scale: of the motion capture: p_lidar = T_lidar_mocap (scale p_mocap). 1 unless asked for.
        scale_sigma: its standard deviation; 0 where it was not estimated.
        T_lidar_target: (4, 4) of each scan, from returns and markers together.
        scatter: the scans' mean square disagreement with the solution, 1 where the covariances are right.
        leave_one_out: errors of each scan's LiDAR estimate, the frames tied by all other scans.
        in_sample: errors with the frames tied by all scans.
    """

    T_lidar_mocap: Floats
    covariance: Floats
    marker_layout: Floats
    layout_sigma: Floats
    scale: float
    scale_sigma: float
    T_lidar_target: tuple[Floats, ...]
    scatter: float
    leave_one_out: tuple[ScanError, ...]
    in_sample: tuple[ScanError, ...]

    @property
    def T_mocap_lidar(self) -> Floats:
        """(4, 4) inverse of T_lidar_mocap."""
        return inverse(self.T_lidar_mocap)

    @property
    def covariance_mocap_lidar(self) -> Floats:
        """(6, 6) of the right perturbation of T_mocap_lidar: rotation first, LiDAR frame."""
        return inverse_covariance(self.T_lidar_mocap, self.covariance)


def calibrate_mocap(
    scans: Sequence[MocapScan],
    *,
    estimate_scale: bool = False,
    marker_noise: float = MARKER_NOISE,
    layout_prior: float = LAYOUT_PRIOR,
) -> MocapCalibration:
    """Calibrate a session, and compare its estimates with the markers.

    Args:
        scans: two at least, all of one target, in one LiDAR and one motion-capture frame.
        estimate_scale: estimate the motion capture's scale as well.
        marker_noise: standard deviation of a marker coordinate, metres.
        layout_prior: standard deviation of a marker's place about its vertex, metres.

    Raises:
        InputError: fewer than two scans, scans of different targets, or a scan with fewer than three markers.
        EstimationError: the graph could not be solved.
    """
    if len(scans) < 2:
        raise InputError(f"a motion-capture calibration needs at least two scans, found {len(scans)}")
    target = scans[0].estimate.target
    if any(not np.array_equal(scan.estimate.target.vertices, target.vertices) for scan in scans):
        raise InputError("a motion-capture calibration is of one target; the scans have several")

    scans = name_alike(scans)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(E(0), gtsam.Pose3(tie(scans)))
    for k, vertex in enumerate(target.vertices):
        values.insert(M(k), vertex)
        graph.push_back(gtsam.PriorFactorPoint3(M(k), vertex, gtsam.noiseModel.Isotropic.Sigma(3, layout_prior)))
    if estimate_scale:
        values.insert(S(0), 1.0)
        graph.push_back(gtsam.PriorFactorDouble(S(0), 1.0, gtsam.noiseModel.Isotropic.Sigma(1, SCALE_PRIOR)))
    for i, scan in enumerate(scans):
        values.insert(H(i), gtsam.Pose3(scan.estimate.T_target_lidar))
        graph.push_back(TemplateFactor(scan.estimate.measurement, H(i)))
        graph.push_back(marker_factor(scan.markers, i, marker_noise, estimate_scale))

    values = _solve(graph, values)
    try:
        marginals = gtsam.Marginals(graph, values)
        covariance = marginals.marginalCovariance(E(0))
        layout = [marginals.marginalCovariance(M(k)) for k in range(len(target))]
        scale_variance = float(marginals.marginalCovariance(S(0))[0, 0]) if estimate_scale else 0.0
    except RuntimeError as error:
        raise EstimationError(f"the session leaves T_lidar_mocap undetermined ({error})") from error
    T_target_lidar = [values.atPose3(H(i)).matrix() for i in range(len(scans))]
    scatter = _scatter(scans, T_target_lidar)
    widening = max(1.0, scatter)
    return MocapCalibration(
        T_lidar_mocap=values.atPose3(E(0)).matrix(),
        covariance=covariance * widening,
        marker_layout=np.array([values.atPoint3(M(k)) for k in range(len(target))]),
        layout_sigma=np.sqrt(np.array([np.diag(block) for block in layout]) * widening),
        scale=values.atDouble(S(0)) if estimate_scale else 1.0,
        scale_sigma=float(np.sqrt(scale_variance * widening)),
        T_lidar_target=tuple(inverse(T) for T in T_target_lidar),
        scatter=scatter,
        leave_one_out=leave_one_out(scans),
        in_sample=in_sample(scans),
    )


def marker_factor(markers: Floats, i: int, sigma: float, with_scale: bool) -> gtsam.CustomFactor:
    """Return the factor of one scan's markers: H_i T_lidar_mocap (s q_k) - m_k for every marker that was seen.

    Args:
        markers: (n, 3) q_k, metres, motion-capture frame, NaN where not seen.
        i: the scan's index, of the key of T_target_lidar.
        sigma: standard deviation of a coordinate, metres.
        with_scale: whether s is a variable.
    """
    seen = np.flatnonzero(np.isfinite(markers).all(axis=1))
    keys = [H(i), E(0), *(M(int(k)) for k in seen), *([S(0)] if with_scale else [])]
    q = markers[seen]

    def evaluate(values: gtsam.Values) -> tuple[Floats, list[Floats]]:
        scale = values.atDouble(S(0)) if with_scale else 1.0
        T_target_lidar, T_lidar_mocap = values.atPose3(H(i)).matrix(), values.atPose3(E(0)).matrix()
        R_t, R_l = T_target_lidar[:3, :3], T_lidar_mocap[:3, :3]
        in_lidar = scale * q @ R_l.T + T_lidar_mocap[:3, 3]
        in_target = in_lidar @ R_t.T + T_target_lidar[:3, 3]
        layout = np.array([values.atPoint3(M(int(k))) for k in seen])
        by_pose = np.vstack([np.hstack([-R_t @ skew(p), R_t]) for p in in_lidar])
        by_frame = np.vstack([R_t @ np.hstack([-R_l @ skew(scale * p), R_l]) for p in q])
        by_layout = [-np.eye(3 * len(seen))[:, 3 * k : 3 * k + 3] for k in range(len(seen))]
        by_scale = [(q @ R_l.T @ R_t.T).reshape(-1, 1)] if with_scale else []
        jacobians = [by_pose, by_frame, *by_layout, *by_scale]
        return (in_target - layout).ravel() / sigma, [J / sigma for J in jacobians]

    return CheckedFactor(evaluate, 3 * len(seen), keys, [6, 6, *[3] * len(seen), *([1] if with_scale else [])])


def _solve(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    result = gtsam.Values(optimizer.optimize())
    if not np.isfinite(graph.error(result)):
        raise EstimationError("the motion-capture graph did not converge: its error is not finite")
    return result


def _scatter(scans: Sequence[MocapScan], T_target_lidar: Sequence[Floats]) -> float:
    """Mean square disagreement of the scans with the joint poses, in their own standard deviations.

    The rise of each measurement's cost above its minimum is chi-square with 6 degrees of freedom, less what the
    common transform and the layout were fitted with.
    """
    rise = sum(
        2 * (scan.estimate.measurement.error(T) - scan.estimate.measurement.error(refine(scan.estimate.measurement)))
        for scan, T in zip(scans, T_target_lidar, strict=True)
    )
    return float(rise / max(6 * len(scans) - 12, 1))
