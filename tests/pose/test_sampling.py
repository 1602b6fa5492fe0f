"""The evidence of a mode against one that is known."""

import gtsam
import numpy as np
import pytest

from optshape_graph.factors.se3 import inverse, inverse_covariance
from optshape_graph.pose import sampling
from optshape_graph.simulation import pose_from_rpy


@pytest.mark.parametrize("off", [0.0, 1.5])
def test_of_a_gaussian(monkeypatch: pytest.MonkeyPatch, off: float) -> None:
    """Even from a covariance that is four times too wide, and a mean that is off by some standard deviations."""
    truth = pose_from_rpy([9.0, 1.0, 0.5], [0.4, -0.3, 2.0])
    sd = np.array([0.05, 0.01, 0.02, 0.01, 0.03, 0.002])
    mixing = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))[0]
    covariance = (mixing * sd**2) @ mixing.T * 0.1 + np.diag(sd**2)

    def likelihood(T: np.ndarray, problem: object, firings: object) -> np.ndarray:
        xi = np.array([gtsam.Pose3.Logmap(gtsam.Pose3(inverse(truth) @ M)) for M in T])
        return -0.5 * np.einsum("si,si->s", xi, np.linalg.solve(covariance, xi.T).T)

    monkeypatch.setattr(sampling, "scan_log_likelihood", likelihood)
    start = truth @ gtsam.Pose3.Expmap(off * sd).matrix()
    guess = inverse_covariance(start, 4 * covariance)  # of T_target_lidar
    mode = sampling.sample_mode(inverse(start), guess, None, None)  # type: ignore[arg-type]
    assert mode.log_evidence == pytest.approx(0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1], abs=0.15)
    assert mode.effective > 200
    xi = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(truth) @ mode.T_lidar_target))
    assert np.abs(xi / np.sqrt(np.diag(covariance))).max() < 0.3
    np.testing.assert_allclose(np.sqrt(np.diag(mode.covariance)), np.sqrt(np.diag(covariance)), rtol=0.2)
    again = sampling.sample_mode(inverse(start), guess, None, None)  # type: ignore[arg-type]
    assert again.log_evidence == mode.log_evidence
