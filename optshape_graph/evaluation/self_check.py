"""A check of the installation: a scan of known truth is simulated, estimated, and solved again as a GTSAM graph."""

from __future__ import annotations

import time
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import H

from optshape_graph.evaluation.metrics import PoseError, normalised_error, pose_error
from optshape_graph.factors import TemplateFactor
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.se3 import difference
from optshape_graph.simulation import NoiseModel, pose_from_rpy, simulate_target

MOST_NEES = 27.9
"""Normalised error squared that one estimate in 10,000 exceeds: chi-square, 6 degrees of freedom."""

MOST_DIFFERENCE = 1e-6
"""Largest difference of GTSAM's pose from the estimate, rad and metres."""


@dataclass(frozen=True)
class SelfCheck:
    """The outcome of the check.

    Attributes:
        error: of the estimate.
        nees: normalised error squared.
        status: of the estimate.
        certified: whether it is certified to be the global optimum.
        graph_difference: difference of GTSAM's pose from the estimate, rad and metres.
        seconds: time of the estimate.
    """

    error: PoseError
    nees: float
    status: str
    certified: bool
    graph_difference: float
    seconds: float

    @property
    def ok(self) -> bool:
        """Whether the installation works."""
        good = self.status == "ok" and self.certified
        return good and self.nees < MOST_NEES and self.graph_difference < MOST_DIFFERENCE


def self_check(seed: int = 0) -> SelfCheck:
    """Simulate the paper's target 8 m before a VLP-32C, estimate its pose, and solve for it again with GTSAM.

    Args:
        seed: of the noise.
    """
    sensor, target = load_sensor("vlp32c"), load_target("paper")
    T_true = pose_from_rpy([8.0, 0.5, 0.2], np.radians([10.0, 15.0, 20.0]))
    scan = simulate_target(target, sensor, T_true, noise=NoiseModel.of(sensor), rng=seed, name="self-check")
    started = time.perf_counter()
    estimate = estimate_pose(scan, target)
    seconds = time.perf_counter() - started

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(TemplateFactor(estimate.measurement, H(0)))
    values.insert(H(0), gtsam.Pose3(estimate.T_target_lidar).retract(np.full(6, 0.01)))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize().atPose3(H(0))
    moved = difference(estimate.T_target_lidar, solved.matrix())
    return SelfCheck(
        error=pose_error(target, estimate.T_lidar_target, T_true),
        nees=normalised_error(target, estimate.T_lidar_target, estimate.covariance, T_true).nees,
        status=estimate.status,
        certified=estimate.certificate.certified,
        graph_difference=float(np.abs(moved).max()),
        seconds=seconds,
    )
