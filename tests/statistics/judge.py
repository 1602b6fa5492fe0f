"""Estimate one scan, and compare the estimate with the truth, modulo the target's symmetries."""

from __future__ import annotations

import time
from typing import Any

import gtsam
import numpy as np

from optshape_graph.errors import EstimationError
from optshape_graph.pose import estimate_pose
from optshape_graph.scan import Scan
from optshape_graph.target import Target

Row = dict[str, Any]


def estimate_row(scan: Scan, target: Target, T_true: np.ndarray) -> Row:
    """Return the columns of one scan; those of the pose are absent where there is none."""
    assert scan.ring is not None
    row: Row = {
        "rings": len(np.unique(scan.ring)),
        "returns": len(scan),
        "range_m": float(np.linalg.norm(T_true[:3, 3])),
    }
    start = time.process_time()
    try:
        estimate = estimate_pose(scan, target)
    except EstimationError as error:
        return {**row, "status": "failed", "reason": str(error), "seconds": time.process_time() - start}
    row["seconds"] = time.process_time() - start
    row["listed"] = is_listed(scan, target, T_true)
    xi = nearest_error(target, estimate.T_lidar_target, T_true)
    return {
        **row,
        "status": estimate.status,
        "reason": estimate.reason,
        "margin": min(float(estimate.ambiguity.margin), 1e6),
        "certified": bool(estimate.certificate.certified),
        "turn_deg": float(np.degrees(np.linalg.norm(xi[:3]))),
        "elsewhere": not of_mode(xi, target),
        "moved_m": float(np.linalg.norm(xi[3:])),
        "nees": float(xi @ np.linalg.solve(estimate.covariance, xi)),
        "sd_deg": float(np.degrees(np.sqrt(np.trace(estimate.covariance[:3, :3])))),
        "sd_m": float(np.sqrt(np.trace(estimate.covariance[3:, 3:]))),
    }


def is_listed(scan: Scan, target: Target, T_true: np.ndarray) -> bool:
    """Whether the true mode is among those that are compared; version 0.1.0 has no such list, and is given credit."""
    try:
        from optshape_graph.pose.evidence import measure
        from optshape_graph.pose.modes import find_candidates
        from optshape_graph.pose.options import PoseOptions
    except ImportError:
        return True
    found = find_candidates(measure([scan], [target], PoseOptions()))[0].T_target_lidar
    return any(of_mode(nearest_error(target, np.linalg.inv(T), T_true), target) for T in found)


def of_mode(xi: np.ndarray, target: Target) -> bool:
    """Whether an error (6,) is within 25 deg and 0.35 target radii: what a margin counts as the same pose."""
    return bool(np.degrees(np.linalg.norm(xi[:3])) < 25.0 and np.linalg.norm(xi[3:]) < 0.35 * target.circumradius)


def nearest_error(target: Target, T_estimate: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    """(6,) right perturbation of the estimate that leads to the nearest of the true pose's equivalents."""
    errors = []
    for angle in target.symmetries:
        turn = gtsam.Pose3(gtsam.Rot3.Rx(angle), np.zeros(3)).matrix()
        errors.append(gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(T_estimate) @ T_true @ turn)))
    return np.array(min(errors, key=lambda xi: float(np.linalg.norm(xi[:3]))))
