"""Covariances against the truth, over many sessions."""

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph.calibration.camera.calibrate import calibrate
from optshape_graph.calibration.camera.factors import INTRINSICS_SIGMA
from optshape_graph.calibration.camera.sightings import View
from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.se3 import difference
from tests.calibration.camera.support import FISHEYE, T_CAMERA_LIDAR, synthetic_views

SESSIONS, VIEWS = 50, 5


def with_drawn_lens(views: list[View], rng: np.random.Generator, square: bool) -> list[View]:
    """The views with a lens that is as far from the true one as the prior of focal lengths and principal point says.

    With square pixels both focal lengths are off alike; the prior has them apart.
    """
    K = np.array(FISHEYE.K)
    K[[0, 1], [0, 1]] += INTRINSICS_SIGMA[:2] * rng.normal(size=1 if square else 2)
    K[[0, 1], [2, 2]] += INTRINSICS_SIGMA[3:5] * rng.normal(size=2)
    given = replace(FISHEYE, K=K)
    return [replace(v, image=replace(v.image, camera=given, poses=planar_poses(v.image.points, given))) for v in views]


def solved(sessions: int, square: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """Return NEES over dof (S, 2), corrected and as clouds come; biases (S,) in sd; the share of views lost.

    Range bias and lens are drawn from their priors.
    """
    normalised, biases, lost = [], [], 0
    for seed in range(sessions):
        rng = np.random.default_rng(seed)
        mean_bias = rng.normal(0.0, 0.03)
        result = calibrate(with_drawn_lens(synthetic_views(VIEWS, rng, mean_bias=mean_bias), rng, square))
        row = []
        for rig in (result.corrected, result.rig):
            T, covariance = result.transform("cam", "lidar", rig)
            x = difference(T_CAMERA_LIDAR, T)
            assert np.degrees(np.linalg.norm(x[:3])) < 5.0  # no wrong symmetry
            row.append(x @ np.linalg.solve(covariance, x) / 6)
        normalised.append(row)
        lost += sum(not view.used for view in result.views)
        bias, sigma = result.range_bias("lidar")
        biases.append((bias - mean_bias) / sigma)
    return np.array(normalised), np.array(biases), lost / (sessions * VIEWS)


def test_covariances_are_not_too_small() -> None:
    """The transform for clouds as they come is as honest as the one for corrected ranges."""
    normalised, biases, _ = solved(15, square=True)
    assert (normalised.mean(axis=0) < 1.38).all()  # of chi-square with 90 degrees, over them, 99 % are below
    assert np.sqrt(np.mean(np.square(biases))) < 1.6  # of 15: its own sd is 0.18


@pytest.mark.benchmark
@pytest.mark.parametrize("square", [True, False])
def test_fifty_sessions_with_known_truth(square: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """NEES over degrees of freedom within 0.8-1.25 (its own sd over 50 sessions is 0.08), 1 % of the views lost."""
    normalised, biases, lost = solved(SESSIONS, square)
    with capsys.disabled():
        print(
            f"\n{'square' if square else 'other'} pixels: NEES / dof {normalised.mean(axis=0).round(2)} (asked: 0.8 to "
            f"1.25), views lost {lost:.1%} (asked: 1 %), range bias {np.sqrt(np.mean(np.square(biases))):.2f} sd"
        )
    assert lost <= 0.01
    assert ((normalised.mean(axis=0) > 0.8) & (normalised.mean(axis=0) < 1.25)).all()
    assert 0.6 < np.sqrt(np.mean(np.square(biases))) < 1.4
