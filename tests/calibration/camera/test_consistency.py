"""Covariances against the truth, over many sessions."""

import gtsam
import numpy as np

from optshape_graph.calibration.camera.calibrate import calibrate
from tests.calibration.camera.support import T_CAMERA_LIDAR, synthetic_views

SESSIONS, VIEWS = 50, 5


def test_fifty_sessions_with_known_truth():
    """NEES over degrees of freedom within 0.8-1.25 (its own sd over 50 sessions is 0.08); no wrong symmetry."""
    normalised, biases, lost = [], [], 0
    for seed in range(SESSIONS):
        rng = np.random.default_rng(seed)
        mean_bias = rng.normal(0.0, 0.03)
        result = calibrate(synthetic_views(VIEWS, rng, mean_bias=mean_bias))
        T, covariance = result.transform("cam", "lidar")
        x = gtsam.Pose3.Logmap(gtsam.Pose3(T_CAMERA_LIDAR).between(gtsam.Pose3(T)))
        assert np.degrees(np.linalg.norm(x[:3])) < 3.0
        lost += sum(not view.used for view in result.views)
        normalised.append(x @ np.linalg.solve(covariance, x) / 6)
        bias, sigma = result.range_bias("lidar")
        biases.append((bias - mean_bias) / sigma)
    assert lost <= 0.01 * SESSIONS * VIEWS
    assert 0.8 < np.mean(normalised) < 1.25
    assert 0.6 < np.sqrt(np.mean(np.square(biases))) < 1.4
