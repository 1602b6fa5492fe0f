"""Modes: evidence by samples against one that is known, and, far away with noisy angles, no flipped pose that is ok."""

import gtsam
import numpy as np
import pytest

from optshape_graph.evaluation.simulation import SimulationSweep, run_simulation
from optshape_graph.factors.se3 import inverse, inverse_covariance
from optshape_graph.io import load_target
from optshape_graph.pose import modes
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

    monkeypatch.setattr(modes, "scan_log_likelihood", likelihood)
    start = truth @ gtsam.Pose3.Expmap(off * sd).matrix()
    guess = inverse_covariance(start, 4 * covariance)  # of T_target_lidar
    mode = modes.sample_mode(inverse(start), guess, None, None)  # type: ignore[arg-type]
    assert mode.log_evidence == pytest.approx(0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1], abs=0.15)
    assert mode.effective > 200
    xi = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(truth) @ mode.T_lidar_target))
    assert np.abs(xi / np.sqrt(np.diag(covariance))).max() < 0.3
    np.testing.assert_allclose(np.sqrt(np.diag(mode.covariance)), np.sqrt(np.diag(covariance)), rtol=0.2)
    again = modes.sample_mode(inverse(start), guess, None, None)  # type: ignore[arg-type]
    assert again.log_evidence == mode.log_evidence


def test_a_flip_is_never_ok(tmp_path) -> None:
    """At noise level 3 (0.3 deg), 24 and 36 m, 4 to 9 rings: no flip is ok; most scans are, and are right."""
    sweep = SimulationSweep(load_target("paper"), None, ("global",), (24.0, 36.0), noise=("3",), draws=10, seed=3)
    rows = run_simulation(sweep, tmp_path)
    e_r = np.array([row["e_r_deg"] for row in rows], dtype=float)
    ok = np.array([row["status"] == "ok" for row in rows])
    assert not (ok & (e_r > 90)).any()
    assert ok.mean() > 0.6
    assert np.mean(e_r > 90) < 0.15
