"""Covariances against the truth, over many sessions."""

from dataclasses import replace

import numpy as np

from optshape_graph.calibration.camera.calibrate import calibrate
from optshape_graph.calibration.camera.factors import INTRINSICS_SIGMA
from optshape_graph.calibration.camera.sightings import View
from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.se3 import difference
from tests.calibration.camera.support import FISHEYE, T_CAMERA_LIDAR, synthetic_views

SESSIONS, VIEWS = 50, 5


def with_drawn_lens(views: list[View], rng: np.random.Generator) -> list[View]:
    """The views with a lens that is as far from the true one as the prior of focal lengths and principal point says."""
    K = np.array(FISHEYE.K)
    K[[0, 1], [0, 1]] += INTRINSICS_SIGMA[0] * rng.normal()  # of both alike: pixels are square
    K[[0, 1], [2, 2]] += INTRINSICS_SIGMA[3:5] * rng.normal(size=2)
    given = replace(FISHEYE, K=K)
    return [replace(v, image=replace(v.image, camera=given, poses=planar_poses(v.image.points, given))) for v in views]


def test_fifty_sessions_with_known_truth():
    """NEES over degrees of freedom within 0.7-1.25 (its own sd over 50 sessions is 0.08); no wrong symmetry.

    The covariance allows for distortion and for pixels that are not square, which are not drawn here: below 1 by that.

    Range bias and lens are drawn from their priors. The transform for clouds as they come is as honest as the one for
    corrected ranges: where the sensors are is what both are measured by.
    """
    normalised, as_they_come, biases, lost = [], [], [], 0
    for seed in range(SESSIONS):
        rng = np.random.default_rng(seed)
        mean_bias = rng.normal(0.0, 0.03)
        result = calibrate(with_drawn_lens(synthetic_views(VIEWS, rng, mean_bias=mean_bias), rng))
        for rig, found in ((result.corrected, normalised), (result.rig, as_they_come)):
            T, covariance = result.transform("cam", "lidar", rig)
            x = difference(T_CAMERA_LIDAR, T)
            assert np.degrees(np.linalg.norm(x[:3])) < 5.0
            found.append(x @ np.linalg.solve(covariance, x) / 6)
        lost += sum(not view.used for view in result.views)
        bias, sigma = result.range_bias("lidar")
        biases.append((bias - mean_bias) / sigma)
    assert lost <= 0.01 * SESSIONS * VIEWS
    assert 0.7 < np.mean(normalised) < 1.25
    assert 0.7 < np.mean(as_they_come) < 1.25
    assert 0.6 < np.sqrt(np.mean(np.square(biases))) < 1.4
