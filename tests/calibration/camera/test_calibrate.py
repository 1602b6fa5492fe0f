from dataclasses import replace

import gtsam
import numpy as np
import pytest

from optshape_graph.calibration.camera.calibrate import calibrate
from optshape_graph.calibration.camera.graph import Unknowns
from optshape_graph.calibration.camera.sightings import View
from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.errors import EstimationError, UnobservableError
from optshape_graph.io.documents import write_json
from optshape_graph.se3 import inverse
from optshape_graph.target import Target
from tests.calibration.camera.support import (
    BOARD,
    FISHEYE,
    PINHOLE,
    T_CAMERA_LIDAR,
    Sensor,
    placement,
    seen_by_camera,
    seen_by_lidar,
    synthetic_views,
    transform,
)
from tests.io.schema_support import complaint


def error(calibration, a="cam", b="lidar", truth=T_CAMERA_LIDAR):
    T, covariance = calibration.transform(a, b)
    return gtsam.Pose3.Logmap(gtsam.Pose3(truth).between(gtsam.Pose3(T))), covariance


@pytest.fixture(scope="module")
def views():
    return synthetic_views(12, np.random.default_rng(0), mean_bias=0.02)


@pytest.fixture(scope="module")
def calibration(views):
    return calibrate(views)


def test_recovers_extrinsic_and_bias_without_a_guess(calibration):
    x, covariance = error(calibration)
    assert x @ np.linalg.solve(covariance, x) < 22.5  # chi-square of 6, 99.9 %
    bias, sigma = calibration.range_bias("lidar")
    assert abs(bias - 0.02) < 3 * sigma + 0.01  # the rings' own mean, 1 cm / sqrt 16, comes on top
    assert all(result.used for result in calibration.views)
    assert calibration.warnings == ()


def test_pinhole():
    x, covariance = error(calibrate(synthetic_views(8, np.random.default_rng(1), PINHOLE)))
    assert x @ np.linalg.solve(covariance, x) < 22.5


def test_same_input_same_output_whatever_the_order(views, calibration):
    again = calibrate(views[::-1])
    assert np.allclose(again.transform("cam", "lidar")[0], calibration.transform("cam", "lidar")[0], atol=1e-5)


def test_equivariant_under_a_turn_of_the_camera():
    """Rotating the image by half a turn about the axis of an ideal camera rotates the camera frame."""
    camera = replace(PINHOLE, D=np.zeros(4), K=np.array([[1100.0, 0, 800], [0, 1100.0, 600], [0, 0, 1]]))
    rng = np.random.default_rng(4)
    upright = synthetic_views(6, rng, camera)
    turned = []
    for view in upright:
        image = view.image
        points = replace(image.points, pixels=[1600, 1200] - image.points.pixels)
        turned.append(replace(view, image=replace(image, points=points, poses=planar_poses(points, camera))))
    T, U = (calibrate(v).transform("cam", "lidar")[0] for v in (upright, turned))
    assert np.allclose(np.diag([-1.0, -1.0, 1.0, 1.0]) @ T, U, atol=1e-5)


def test_swapped_views_are_rejected_and_named(views):
    swapped = list(views)
    swapped[3] = replace(views[3], image=views[7].image, image_name=views[7].image_name)
    swapped[7] = replace(views[7], image=views[3].image, image_name=views[3].image_name)
    result = calibrate(swapped)
    assert [k for k, view in enumerate(result.views) if not view.used] == [3, 7]
    assert "fits the image 03.png instead: were they swapped?" in result.views[3].reason
    assert "fits the image 07.png instead: were they swapped?" in result.views[7].reason
    x, covariance = error(result)
    assert x @ np.linalg.solve(covariance, x) < 22.5


def test_a_target_that_moved_between_scan_and_image_is_rejected(views):
    rng = np.random.default_rng(5)
    moved = list(views)
    moved[2] = replace(views[2], image=seen_by_camera(FISHEYE, T_CAMERA_LIDAR @ placement(rng), BOARD, rng))
    result = calibrate(moved)
    assert [k for k, view in enumerate(result.views) if not view.used] == [2]
    assert "scan and image disagree by" in result.views[2].reason
    assert result.views[2].errors.centre_error_mm > 50


def test_views_without_a_sighting_are_reported(views):
    result = calibrate([*views[:6], View("x", BOARD, None, views[7].image, "a.pcd", "b.png", "no board in a.pcd")])
    assert result.views[6].reason == "no board in a.pcd"
    assert result.views[6].errors is None


def test_two_views_suffice_but_are_warned_of(views):
    result = calibrate(views[:2])
    assert "2 views took part: too few" in result.warnings[0]
    x, covariance = error(result)
    assert x @ np.linalg.solve(covariance, x) < 22.5


def test_two_views_that_contradict_each_other(views):
    wrong = replace(views[1], image=views[2].image)
    with pytest.raises(EstimationError, match="only 1 of the 2 views"):
        calibrate([views[0], wrong])


def test_one_view_of_a_symmetric_target_is_ambiguous(views):
    with pytest.raises(UnobservableError, match="second relative pose fits") as caught:
        calibrate(views[:1])
    assert "symmetric poses" in caught.value.directions[0]


def test_parallel_views_name_what_rests_on_edges():
    rng = np.random.default_rng(6)
    placements = []
    for _ in range(6):
        T = placement(rng)
        T[:3, :3] = placement(np.random.default_rng(0))[:3, :3]
        placements.append(T)
    result = calibrate(synthetic_views(6, rng, placements=placements))
    assert any(
        "nearly parallel" in warning and "rest on the target's edges alone" in warning for warning in result.warnings
    )
    x, covariance = error(result)
    assert x @ np.linalg.solve(covariance, x) < 22.5
    assert result.directions("lidar", "cam")[0].sigma_m > 2e-3


def test_nothing_in_any_scan():
    with pytest.raises(EstimationError, match="no target was found in any scan"):
        calibrate([View("0", BOARD)])


def test_sensors_without_a_common_target(views):
    halves = [replace(v, image=None, placement=f"a{k}") for k, v in enumerate(views[:3])]
    halves += [replace(v, scan=None, placement=f"b{k}") for k, v in enumerate(views[3:6])]
    with pytest.raises(UnobservableError, match="'cam' saw no target that 'lidar'"):
        calibrate(halves)


def test_several_sensors_jointly(tmp_path):
    """Two LiDARs and two cameras; the second camera shares views with the second LiDAR only."""
    rng = np.random.default_rng(7)
    T_front_rear = transform(gtsam.Rot3.RzRyRx(0.05, -0.1, 0.2).matrix(), np.array([0.2, 0.3, -0.1]))
    T_right_rear = T_CAMERA_LIDAR @ transform(gtsam.Rot3.RzRyRx(0.0, 0.05, -0.1).matrix(), np.array([0.1, 0.05, 0]))
    front, rear = Sensor.drawn("front", rng), Sensor.drawn("rear", rng)
    right = replace(PINHOLE, name="right")
    views = []
    for k in range(8):
        T = placement(rng)
        T_rear = inverse(T_front_rear) @ T
        scan = seen_by_lidar(rear, T_rear, BOARD, rng)
        left_image = seen_by_camera(FISHEYE, T_CAMERA_LIDAR @ T, BOARD, rng)
        right_image = seen_by_camera(right, T_right_rear @ T_rear, BOARD, rng)
        views.append(View(str(k), BOARD, seen_by_lidar(front, T, BOARD, rng), left_image, f"f{k}", f"l{k}"))
        views.append(View(str(k), BOARD, scan, right_image, f"r{k}", f"r{k}"))
    result = calibrate(views)
    assert result.lidars == ("front", "rear")
    assert result.cameras == ("cam", "right")
    for a, b, truth in (
        ("cam", "front", T_CAMERA_LIDAR),
        ("right", "rear", T_right_rear),
        ("front", "rear", T_front_rear),
        ("right", "front", T_right_rear @ inverse(T_front_rear)),
    ):
        x, covariance = error(result, a, b, truth)
        assert x @ np.linalg.solve(covariance, x) < 22.5, (a, b)
    write_json(tmp_path / "camera.json", result.to_dict())
    assert complaint(tmp_path / "camera.json") is None


def test_target_without_symmetry_and_pattern_with_one():
    rng = np.random.default_rng(8)
    kite = Target.from_polygon([(-0.35, -0.5), (0.4, -0.45), (0.35, 0.45), (-0.35, 0.5)], "kite")
    kite = replace(kite, chessboard=BOARD.chessboard)
    x, covariance = error(calibrate(synthetic_views(6, rng, target=kite)))
    assert x @ np.linalg.solve(covariance, x) < 22.5


def test_intrinsics_are_refined():
    rng = np.random.default_rng(9)
    views = synthetic_views(10, rng)
    wrong = replace(FISHEYE, K=FISHEYE.K + np.diag([8.0, 8.0, 0.0]))
    given = [replace(v, image=replace(v.image, camera=wrong, poses=planar_poses(v.image.points, wrong))) for v in views]
    result = calibrate(given, Unknowns(intrinsics=True))
    refined = result.rig.cameras["cam"]
    assert abs(refined.K[0, 0] - FISHEYE.K[0, 0]) < 3.0
    x, _ = error(result)
    kept, _ = error(calibrate(given))
    assert np.linalg.norm(x[3:]) < np.linalg.norm(kept[3:]) or np.linalg.norm(x[3:]) < 5e-3


def test_leave_one_out_does_not_see_the_view(views, calibration):
    """What is said of a view is what its own extrinsic-without-it says."""
    left_out = calibration.cross_validations[0].views[4]
    others = calibrate([view for k, view in enumerate(views) if k != 4])
    T = others.transform("cam", "lidar")[0]
    scan, image = views[4].scan, views[4].image
    predicted = T @ scan.pose(0.0)
    centres = [pose @ np.linalg.inv(S) for S in image.points.symmetries for pose in [image.poses[0].T_camera_target]]
    distances = [1e3 * np.linalg.norm(predicted[:3, 3] - C[:3, 3]) for C in centres]
    # The discrepancy is estimated from all views there, and from the others here.
    assert min(abs(left_out.centre_error_mm - d) for d in distances) < 0.3


def test_suggested_placement_helps(views):
    few = views[:5]
    place = calibrate(few).next_placement("lidar", "cam")
    assert place.expected_sigma_m < place.sigma_m
    rng = np.random.default_rng(10)
    sensor = Sensor.drawn("lidar", np.random.default_rng(0), 0.02)
    T = place.T_lidar_target
    extra = View(
        "extra", BOARD, seen_by_lidar(sensor, T, BOARD, rng), seen_by_camera(FISHEYE, T_CAMERA_LIDAR @ T, BOARD, rng)
    )
    after = calibrate([*few, extra]).most_likely_sigma("lidar", "cam")
    assert after < place.sigma_m


def test_two_views_are_not_called_parallel(views):
    """Two planes that differ are turned about one axis: one translation rests on edges, not two."""
    (few, turned) = calibrate(views[:2]).warnings
    assert "2 views took part" in few
    assert "turned about one axis only" in turned
    assert "the translation along LiDAR" in turned


def test_why_no_target_was_found(views):
    nothing = [replace(view, scan=None, problem="a.pcd: no board") for view in views[:3]]
    with pytest.raises(EstimationError, match=r"no target was found in any scan; a\.pcd: no board"):
        calibrate(nothing)
