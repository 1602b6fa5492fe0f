from dataclasses import replace

import numpy as np
import pytest

from optshape_graph.calibration.camera.calibrate import calibrate
from optshape_graph.calibration.camera.graph import Unknowns
from optshape_graph.calibration.camera.lens import FEWEST_IMAGES, check_lenses
from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.camera import CameraIntrinsics
from tests.calibration.camera.support import FISHEYE, PINHOLE, synthetic_views

BENT = replace(FISHEYE, D=FISHEYE.D + np.array([0.12, -0.1, 0.0, 0.0]))


def images(views):
    return [view.image for view in views if view.image is not None]


def with_camera(views, camera: CameraIntrinsics):
    """The same pixels, taken for another camera's."""
    return [
        replace(v, image=replace(v.image, camera=camera, poses=planar_poses(v.image.points, camera))) for v in views
    ]


@pytest.fixture(scope="module")
def views():
    return synthetic_views(12, np.random.default_rng(3))


@pytest.mark.parametrize("camera", [FISHEYE, PINHOLE])
@pytest.mark.parametrize("seed", range(5))
def test_a_right_lens_is_not_contradicted(camera, seed):
    (check,) = check_lenses(images(synthetic_views(12, np.random.default_rng(seed), camera)))
    assert not check.contradicted
    assert check.images == 12
    assert check.rms_px == pytest.approx(0.2, rel=0.1)  # the noise that the corners are simulated with
    assert check.refined_rms_px == pytest.approx(check.rms_px, rel=0.02)


def test_a_wrong_lens_is(views):
    (check,) = check_lenses(images(with_camera(views, BENT)))
    assert check.contradicted
    assert check.rms_px > 0.25
    assert check.refined_rms_px == pytest.approx(0.2, rel=0.15)


def test_few_images_say_nothing(views):
    assert check_lenses(images(views[: FEWEST_IMAGES - 1])) == ()


def test_a_lens_that_cannot_be_refined_is_left_out(views):
    rational = replace(PINHOLE, name="long", D=np.array([-0.2, 0.05, 0, 0, 0.01, 0, 0, 0.02]))
    assert check_lenses(images(with_camera(views, rational))) == ()


def test_calibration_refines_what_the_images_contradict(views):
    """The same data with the right lens, with a wrong one refined, and with the wrong one kept."""
    right = calibrate(views)
    refined = calibrate(with_camera(views, BENT))
    kept = calibrate(with_camera(views, BENT), Unknowns(intrinsics=False))
    assert (right.refined, refined.refined, kept.refined) == (set(), {"cam"}, set())
    assert right.warnings == ()
    assert "T_camera_lidar belongs to the refined lens" in refined.warnings[-1]
    assert "calibrate the camera again" in kept.warnings[-1]

    def centre_mm(calibration):
        return calibration.cross_validations[0].means()["mean_centre_error_mm"]

    assert centre_mm(refined) < 1.1 * centre_mm(right)  # that the lens is not known costs something
    assert centre_mm(refined) < centre_mm(kept)
    # The principal point is refined too; here it was right, and stays so within a few pixels.
    np.testing.assert_allclose(refined.rig.cameras["cam"].K[:2, 2], BENT.K[:2, 2], atol=6.0)
    np.testing.assert_allclose(refined.given.cameras["cam"].K, BENT.K)
