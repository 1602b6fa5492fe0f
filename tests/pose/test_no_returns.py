"""Points that are no returns, and numbers that fail: a scan's pose does not suffer from them, nor do the others'."""

from __future__ import annotations

import numpy as np
import pytest

from optshape_graph import EstimationError, Scan, estimate_pose, estimate_poses
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate
from tests.pose.clouds import simulated

PAPER = load_target("paper")


@pytest.mark.parametrize("factor", [0.0, 1e-6, 1e8, 1e100, 1e200])
@pytest.mark.parametrize("count", [1, 3])
def test_points_that_are_no_returns_are_left_out(factor: float, count: int) -> None:
    scan, _ = simulated(5.0, (10.0, -20.0, 15.0))
    points, none = scan.points.copy(), np.arange(0, 50 * count, 50)
    points[none] *= factor
    found = estimate_pose(Scan(points, scan.ring, sensor=scan.sensor), PAPER)
    expected = estimate_pose(scan.select(np.delete(np.arange(len(scan)), none)), PAPER)
    assert found.n_returns == len(scan) - count
    np.testing.assert_allclose(found.T_lidar_target, expected.T_lidar_target, atol=1e-9)


def test_nothing_but_points_that_are_none() -> None:
    with pytest.raises(EstimationError):
        estimate_pose(Scan(np.zeros((20, 3)), np.repeat([0, 1], 10)), PAPER)


def test_a_plane_about_the_sensor_is_refused() -> None:
    points = np.array([[1e-3, 1, 0], [1e-3, -1, 1], [1e-3, 0, -1]])
    with pytest.raises(EstimationError, match="passes through the sensor"):
        estimate_pose(Scan(points, np.array([1, 2, 0]), sensor=load_sensor("vlp16")), PAPER)


def test_numbers_that_fail_cost_one_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Linear algebra that fails for a scan of a batch is the error of that scan."""
    scans = [simulated(5.0, seed=k)[0] for k in range(3)]
    bad, measured = scans[1], estimate.measure

    def failing(right: list[Scan], *rest: object, **more: object) -> object:
        if any(np.array_equal(one.points, bad.points) for one in right):
            raise np.linalg.LinAlgError("Eigenvalues did not converge")
        return measured(right, *rest, **more)

    monkeypatch.setattr(estimate, "measure", failing)
    found = estimate_poses(scans, PAPER)
    assert [isinstance(one, EstimationError) for one in found] == [False, True, False]
    assert "no pose can be worked out" in str(found[1])
