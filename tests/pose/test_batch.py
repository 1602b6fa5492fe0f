"""Poses of many scans at once: what is said of each is what is said of it alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optshape_graph import Scan, Target, estimate_poses
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io import load_target
from optshape_graph.pose import PoseEstimate, estimate_pose
from optshape_graph.pose.modes import COMPETING
from optshape_graph.se3 import difference
from tests.pose.clouds import recorded_cases, reference_cases, simulated
from tests.shared import needs_shared

SHAPES = ("paper", "built", "square", "triangle", "optimal", "diamond")
SENSORS = ("vlp16", "vlp32c", "os1-64", "hdl64e")


def alone(scan: Scan, target: Target, **options: str) -> PoseEstimate | EstimationError:
    try:
        return estimate_pose(scan, target, **options)
    except EstimationError as error:
        return error


def assert_same(at_once: PoseEstimate | EstimationError, alone: PoseEstimate | EstimationError) -> None:
    """Sums over padded ends round otherwise, and a pose is 1e6 times as well conditioned as its sums: 1e-5 of an sd.

    Of margins beyond COMPETING only that they are: the mass elsewhere, e^-50 of all and less, is that of one sample.
    """
    if isinstance(alone, EstimationError):
        assert str(at_once) == str(alone)
        return
    assert isinstance(at_once, PoseEstimate)
    assert (at_once.status, at_once.reason, at_once.scan) == (alone.status, alone.reason, alone.scan)
    pose = alone.target.nearest_equivalent(at_once.T_lidar_target[None], alone.T_lidar_target)[0]
    off = difference(alone.T_lidar_target, pose[None])[0] / np.sqrt(np.diag(alone.covariance))
    np.testing.assert_allclose(off, 0.0, atol=1e-5)
    np.testing.assert_allclose(at_once.covariance, alone.covariance, atol=1e-5 * np.abs(alone.covariance).max())
    margins = np.minimum([at_once.ambiguity.margin, alone.ambiguity.margin], COMPETING)
    np.testing.assert_allclose(margins[0], margins[1], rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(at_once.labels, alone.labels)
    np.testing.assert_allclose(at_once.edge_sigma, alone.edge_sigma, rtol=1e-4)
    assert at_once.certificate.certified == alone.certificate.certified
    assert at_once.fit.summary == alone.fit.summary


@needs_shared
def test_published_and_recorded_scans() -> None:
    pairs = [(case.scan, load_target("paper")) for case in reference_cases()] + list(recorded_cases())
    found = estimate_poses([scan for scan, _ in pairs], [target for _, target in pairs])
    for one, (scan, target) in zip(found, pairs, strict=True):
        assert_same(one, alone(scan, target))


@settings(max_examples=8)
@given(
    st.lists(
        st.tuples(st.sampled_from(SHAPES), st.sampled_from(SENSORS), st.floats(2.5, 15.0), st.integers(0, 2**31 - 1)),
        min_size=1,
        max_size=6,
    )
)
def test_mixes_of_shapes_sensors_and_numbers_of_rings(drawn: list[tuple[str, str, float, int]]) -> None:
    scans, targets = [], []
    for shape, sensor, distance, seed in drawn:
        turned = np.random.default_rng(seed).uniform(-30, 30, 3)
        scans.append(simulated(distance, tuple(turned), seed, target=shape, sensor=sensor)[0])
        targets.append(load_target(shape))
    for one, scan, target in zip(estimate_poses(scans, targets), scans, targets, strict=True):
        assert_same(one, alone(scan, target))


def test_a_scan_without_a_pose_does_not_stop_the_others() -> None:
    scan, _ = simulated(6.0, (10.0, 20.0, 5.0), 3)
    line = Scan(scan.points[:1].repeat(5, axis=0), np.zeros(5, dtype=int), sensor=scan.sensor, name="a point")
    cloud = Scan(scan.points, None, sensor=scan.sensor, name="no rings")
    first, none, last, bare = estimate_poses([scan, line, scan, cloud], load_target("paper"))
    assert isinstance(none, EstimationError)
    for found, of in ((first, scan), (last, scan), (bare, cloud)):
        assert_same(found, alone(of, load_target("paper")))


def test_the_published_method_and_backends_too() -> None:
    scan, _ = simulated(6.0, (10.0, 20.0, 5.0), 3)
    for options in ({"method": "paper"}, {"backend": "clarabel"}):
        (found,) = estimate_poses([scan], load_target("paper"), **options)
        assert_same(found, alone(scan, load_target("paper"), **options))


def test_what_is_refused() -> None:
    scan, _ = simulated(6.0, (10.0, 20.0, 5.0), 3)
    assert estimate_poses([], load_target("paper")) == []
    with pytest.raises(InputError, match="2 targets for 1 scans"):
        estimate_poses([scan], [load_target("paper"), load_target("square")])
    with pytest.raises(InputError, match="scan"):
        estimate_poses(["a"], load_target("paper"))
    with pytest.raises(InputError, match="method is 'best'"):
        estimate_poses([scan], load_target("paper"), method="best")
