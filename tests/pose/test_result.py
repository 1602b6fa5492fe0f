"""The other names of a symmetric target's vertices: what an estimate says under each is the same."""

import numpy as np
import pytest

from optshape_graph.io import load_target
from optshape_graph.pose import estimate_pose
from tests.pose.clouds import simulated
from tests.pose.rosettes import rosette


@pytest.mark.parametrize("rings", [True, False])
def test_equivalent_estimates_agree(rings: bool) -> None:
    square = load_target("square")
    scan = simulated(6.0, (3, 5, 0), 1, square)[0] if rings else rosette(square, 6.0, 6000, 1)[0]
    estimate = estimate_pose(scan, square)
    for k in range(4):
        other = estimate.equivalent(k)
        T = other.T_target_lidar
        np.testing.assert_allclose(other.T_lidar_target, estimate.equivalent_poses[k], atol=1e-12)
        np.testing.assert_allclose(np.roll(other.vertices, k, axis=0), estimate.vertices, atol=1e-9)
        assert other.measurement.error(T) == pytest.approx(estimate.measurement.error(estimate.T_target_lidar))
        # The errors that scans share are the same, and move the turned pose alike.
        assert other.shared is not None
        assert estimate.shared is not None
        assert other.shared.shared == estimate.shared.shared
        ours, theirs = other.shared.marginal(1.0), estimate.shared.marginal(1.0)
        assert ours.error(T) == pytest.approx(theirs.error(estimate.T_target_lidar), rel=1e-6)
        np.testing.assert_allclose(
            np.sort(np.linalg.eigvalsh(ours.information(T)[:3, :3])),
            np.sort(np.linalg.eigvalsh(theirs.information(estimate.T_target_lidar)[:3, :3])),
            rtol=1e-6,
        )
        lines = square.normals[other.labels], square.offsets[other.labels]
        if rings:
            moved = (other.edge_points.points @ T[:3, :3].T + T[:3, 3])[:, 1:]
            assert np.abs((lines[0] * moved).sum(axis=1) - lines[1]).max() < 0.1
