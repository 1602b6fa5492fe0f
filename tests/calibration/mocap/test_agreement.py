"""The vote of the scans on where the motion capture is."""

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph.calibration.mocap.agreement import find_agreement, placements, without_fallen_marker
from optshape_graph.calibration.mocap.comparison import in_sample, leave_one_out
from optshape_graph.errors import EstimationError
from tests.calibration.mocap.test_comparison import perfect_scans, random_pose


def test_symmetric_targets_are_named_as_their_markers() -> None:
    scans = perfect_scans(4, random_pose(np.random.default_rng(5)), "square")
    shuffled = [replace(scan, estimate=scan.estimate.equivalent(k)) for k, scan in enumerate(scans)]
    assert max(e.e_r_deg for e in in_sample(shuffled)) > 40
    errors = leave_one_out(find_agreement(shuffled, "session").scans)
    assert max(max(e.rmse_m, e.e_t_m, e.e_r_deg) for e in errors) < 1e-6


def test_one_scan_is_outvoted() -> None:
    T_mocap_lidar = random_pose(np.random.default_rng(6))
    scans = perfect_scans(5, T_mocap_lidar)
    scans[3] = replace(scans[3], markers=scans[3].markers + np.array([0.0, 0.0, 2.0]))
    found = find_agreement(scans, "session")
    assert found.agreeing.tolist() == [True, True, True, False, True]
    np.testing.assert_allclose(found.T_lidar_mocap @ T_mocap_lidar, np.eye(4), atol=1e-6)


def test_mirrored_markers_are_known_where_the_target_turned() -> None:
    scans = [replace(scan, markers=scan.markers * [1, 1, -1]) for scan in _turned(6)]
    with pytest.raises(EstimationError, match=r"mirrored: \d of 6 scans agree as they are, 6 with one axis negated"):
        find_agreement(scans, "session")


def test_permuted_frames_are_put_in_their_places() -> None:
    scans = _turned(5)
    rolled = [replace(scan, markers=scans[k - 1].markers, frame=k - 1) for k, scan in enumerate(scans)]
    with pytest.raises(EstimationError, match="frames look permuted: 0 fits frame 0, 1 fits frame 1"):
        find_agreement(rolled, "session")


def test_the_fallen_marker_is_the_one_without_which_the_scans_agree() -> None:
    scans = _turned(4)
    for scan in scans:
        R = scan.T_mocap_target[:3, :3]
        scan.markers[2] += R @ [0.0, -0.2, 0.2]
    rest, k = without_fallen_marker(scans, [0, 1, 2, 3])
    assert k == 2
    assert all(np.isnan(scan.markers[2]).all() for scan in rest)


def test_a_place_counts_once() -> None:
    scans = perfect_scans(3, np.eye(4))
    assert placements([scans[0], scans[0], scans[1]]) == 2


def _turned(n: int) -> list:
    """Scans whose target is turned about all axes."""
    rng = np.random.default_rng(8)
    T_mocap_lidar = random_pose(rng)
    scans = []
    for k, scan in enumerate(perfect_scans(n, T_mocap_lidar)):
        T = np.array(scan.estimate.T_lidar_target)
        turn = random_pose(rng)
        T[:3, :3] = T[:3, :3] @ np.linalg.qr(np.eye(3) + 0.4 * (turn[:3, :3] - turn[:3, :3].T))[0]
        T[:3, :3] *= np.sign(np.linalg.det(T[:3, :3]))
        T[:3, 3] += rng.uniform(-1, 1, 3)
        estimate = replace(scan.estimate, T_lidar_target=T)
        in_mocap = estimate.vertices @ T_mocap_lidar[:3, :3].T + T_mocap_lidar[:3, 3]
        scans.append(replace(scan, name=str(k), estimate=estimate, markers=in_mocap, frame=k))
    return scans
