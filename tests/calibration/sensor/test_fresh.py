"""Poses by a sensor whose errors are known, where little but the ring ends is left to be wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph.io import load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.se3 import difference
from optshape_graph.simulation import pose_from_rpy
from tests.calibration.sensor.units import Unit


@pytest.mark.parametrize(("unit", "scan"), [((79, 0), (80, 5, 3)), ((9100, 2), (9102, 5, 0, 13))])
def test_a_ring_along_an_edge_does_not_pull_the_pose(unit: tuple[int, ...], scan: tuple[int, ...]) -> None:
    """NEES / dof below 3.7, which one pose in a thousand exceeds; it was 6.2 and 6.9, four centimetres off.

    A lone return of a ring that runs beside an edge, within the beam, and the ends of one of which every fifth ray
    returns, were taken for ends at the edges to the left and right.
    """
    copy, target, rng = (
        Unit.drawn("vlp32c", np.random.default_rng(unit)),
        load_target("paper"),
        np.random.default_rng(scan),
    )
    T = pose_from_rpy([5, *rng.normal(0, 0.3, 2)], np.radians(rng.uniform(-25, 25, 3)))
    estimate = estimate_pose(replace(copy.scan(target, T, rng), sensor=copy.known), target)
    off = difference(T, estimate.T_lidar_target)
    assert estimate.status == "ok"
    assert off @ np.linalg.solve(estimate.covariance, off) / 6 < 3.7
