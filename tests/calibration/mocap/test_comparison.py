"""Comparison with motion capture: protocols on synthetic sessions with known errors."""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError, Target
from optshape_graph.calibration.mocap.comparison import (
    MocapScan,
    align,
    assign_markers,
    fit_template,
    in_sample,
    leave_one_out,
    mean_error,
)
from optshape_graph.io import load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.simulation import pose_from_rpy
from tests.pose.clouds import simulated


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return gtsam.Pose3.Expmap(np.concatenate([rng.uniform(-1, 1, 3), rng.uniform(-5, 5, 3)])).matrix()


def moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def perfect_scans(n: int, T_mocap_lidar: np.ndarray, name: str = "paper") -> list[MocapScan]:
    """Scans whose markers are on the estimate's vertices: no error in any protocol."""
    estimate = estimate_pose(simulated(6.0, seed=1, target=name)[0], load_target(name))
    scans = []
    for k in range(n):
        T = pose_from_rpy([6.0 + k, 0.3 * k, -0.1 * k], [0.1 * k, 0.2, 0.05 * k])
        moved_estimate = replace(estimate, T_lidar_target=T)
        scans.append(MocapScan(f"{k}", moved_estimate, moved(T_mocap_lidar, moved_estimate.vertices)))
    return scans


@given(st.integers(0, 2**31 - 1))
def test_align_recovers_a_rigid_transform(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, points = random_pose(rng), rng.normal(size=(5, 3))
    np.testing.assert_allclose(align(moved(T, points), points), T, atol=1e-8)


def test_align_refuses_a_line() -> None:
    points = np.outer(np.arange(4.0), [1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="do not fix"):
        align(points, points)


def test_no_error_where_there_is_none() -> None:
    scans = perfect_scans(4, random_pose(np.random.default_rng(3)))
    for errors in (leave_one_out(scans), in_sample(scans)):
        assert max(max(e.rmse_m, e.e_t_m, e.e_r_deg) for e in errors) < 1e-6


def test_a_wrong_scan_shows_in_full_only_when_left_out() -> None:
    scans = perfect_scans(3, random_pose(np.random.default_rng(4)))
    shift = np.eye(4)
    shift[:3, 3] = [0.0, 0.09, 0.0]
    wrong = replace(
        scans[1], estimate=replace(scans[1].estimate, T_lidar_target=scans[1].estimate.T_lidar_target @ shift)
    )
    scans[1] = wrong
    assert leave_one_out(scans)[1].e_t_m == pytest.approx(0.09, abs=1e-6)
    assert in_sample(scans)[1].e_t_m < 0.075


def test_equivalent_estimates_describe_the_same_thing() -> None:
    estimate = estimate_pose(simulated(6.0, (5, 0, 0), 2, "square")[0], load_target("square"))
    other = estimate.equivalent(1)
    gaps = np.linalg.norm(estimate.vertices[:, None] - other.vertices[None], axis=-1).min(axis=1)
    assert gaps.max() < 1e-9
    assert other.measurement.error(other.T_target_lidar) == pytest.approx(
        estimate.measurement.error(estimate.T_target_lidar)
    )
    np.testing.assert_allclose(
        np.linalg.inv(other.measurement.information(other.T_target_lidar)), other.covariance_target_lidar, rtol=1e-3
    )
    # The same edge points are on the same lines, whatever these are called.
    for e in (estimate, other):
        moved_points = moved(e.T_target_lidar, e.edge_points.points)[:, 1:]
        distance = (e.target.normals[e.labels] * moved_points).sum(axis=1) - e.target.offsets[e.labels]
        assert np.abs(distance).max() < 0.1


def test_missing_markers() -> None:
    target = load_target("paper")
    markers = target.vertices + np.array([1.0, 2.0, 3.0])
    markers[2] = np.nan
    np.testing.assert_allclose(fit_template(target, markers)[:3, 3], [1, 2, 3], atol=1e-9)
    markers[0] = np.nan
    with pytest.raises(InputError, match="2 of 4 markers"):
        fit_template(target, markers, "frame 7")


@given(st.permutations(range(4)), st.integers(0, 2**31 - 1))
def test_markers_are_assigned_by_shape(order: Sequence[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = load_target("built")
    frames = []
    for _ in range(3):
        near = target.vertices + rng.normal(0, 0.01, (4, 3))
        frames.append(moved(random_pose(rng), near)[list(order)])
    assignment = assign_markers(target, frames)
    assert [order[k] for k in assignment] == [0, 1, 2, 3]


def test_a_symmetric_layout_cannot_be_assigned() -> None:
    square = load_target("square")
    with pytest.raises(InputError, match="fit alike"):
        assign_markers(square, [square.vertices])


def test_other_numbers_of_markers_cannot_be_assigned() -> None:
    with pytest.raises(InputError, match="5 markers for 4 vertices"):
        assign_markers(load_target("paper"), [np.random.default_rng(0).normal(size=(5, 3))])
    with pytest.raises(InputError, match="no frame"):
        assign_markers(load_target("paper"), [np.full((4, 3), np.nan)])


def test_one_scan_cannot_be_left_out() -> None:
    with pytest.raises(InputError, match="at least two"):
        leave_one_out(perfect_scans(1, np.eye(4)))


def test_mean() -> None:
    errors = leave_one_out(perfect_scans(3, np.eye(4)))
    assert mean_error(errors).rmse_m == pytest.approx(np.mean([e.rmse_m for e in errors]))


def test_target_is_a_noun_here() -> None:
    assert isinstance(perfect_scans(2, np.eye(4))[0].estimate.target, Target)
