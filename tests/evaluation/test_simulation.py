"""The simulation sweep: the paper's clouds, jitter, partial illumination, failures."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from optshape_graph import EstimationError, InputError
from optshape_graph.evaluation.simulation import SimulationSweep, run_simulation, true_pose
from optshape_graph.io import load_sensor, load_target
from optshape_graph.runs.workers import Pool
from optshape_graph.simulation.reference import reference_pose

TARGET = load_target("paper")
FACE = (("face", (0.0, 0.0, 0.0)),)


@dataclass
class Fake:
    """An estimate."""

    T_lidar_target: np.ndarray
    covariance: np.ndarray
    status: str = "ok"


def centroid(scan, target, method):
    """An estimator of its own: the mean of the returns; fails on few."""
    if len(scan) < 20:
        raise EstimationError(f"{len(scan)} returns are too few")
    T = np.eye(4)
    T[:3, 3] = scan.points.mean(axis=0) + (0.1 if method == "paper" else 0.0)
    return Fake(T, np.eye(6) * 1e-2)


def test_without_jitter_and_noise_the_points_are_the_published_ones(tmp_path):
    sweep = SimulationSweep(TARGET, noise=("0",), draws=1, jitter=False)
    rows = run_simulation(sweep, tmp_path, estimator=centroid)
    assert len(rows) == 80
    face = [row["n_points"] for row in rows if row["orientation"] == "face" and row["method"] == "paper"]
    assert face[:4] == [2530, 1015, 548, 338]
    failed = [row for row in rows if row["status"] == "failed"]
    assert {row["rmse_m"] for row in failed} == {None}
    assert all(row["n_points"] < 20 and "too few" in row["reason"] for row in failed)
    first = next(row for row in rows if row["method"] == "global")
    assert first["distance_m"] == pytest.approx(2.00461, abs=1e-4)
    assert first["e_q_m"] == pytest.approx(0.0139948, rel=1e-4)
    assert 0 < first["bound_rmse_m"] < 0.01


def test_both_methods_see_the_same_cloud_and_draws_differ(tmp_path):
    sweep = SimulationSweep(TARGET, distances=(6.0,), orientations=FACE, noise=("1",), draws=6)
    rows = run_simulation(sweep, tmp_path, estimator=centroid)
    by_method = {name: [row for row in rows if row["method"] == name] for name in ("global", "paper")}
    for ours, papers in zip(by_method["global"], by_method["paper"], strict=True):
        assert papers["error_tx"] - ours["error_tx"] == pytest.approx(-0.1, abs=1e-9)
    assert len({row["error_tx"] for row in by_method["global"]}) == 6


def test_results_depend_on_the_seed_alone(tmp_path):
    sweep = SimulationSweep(TARGET, distances=(6.0, 9.0), orientations=FACE, noise=("3", "sensor"), draws=5)
    one = run_simulation(sweep, tmp_path / "1", estimator=centroid)
    assert one == run_simulation(sweep, tmp_path / "2", estimator=centroid, pool=Pool(2))
    other = run_simulation(replace(sweep, seed=1), tmp_path / "3", estimator=centroid)
    assert [row["error_ty"] for row in one] != [row["error_ty"] for row in other]


def test_jitter_stays_within_a_step_and_a_ring_gap():
    sweep = SimulationSweep(TARGET)
    rng = np.random.default_rng(0)
    nominal = reference_pose(TARGET, 20.0, (0.0, 0.0, 0.0))
    moved = np.array([true_pose(sweep, (0.0, 0.0, 0.0), 20.0, rng)[:3, 3] - nominal[:3, 3] for _ in range(500)])
    step, gap = np.radians(0.4) * 20, np.radians(1 / 3 + 0.004) * 20  # gaps near the horizon: 0.333 deg and the rise
    assert np.abs(moved[:, 0]).max() == 0
    assert 0.45 * step < np.abs(moved[:, 1]).max() <= 0.5 * step
    assert 0.45 * gap < np.abs(moved[:, 2]).max() <= 0.505 * gap


@pytest.mark.parametrize("removal", ["random", "lowest", "highest"])
def test_rings_are_removed(tmp_path, removal):
    sweep = SimulationSweep(
        TARGET, load_sensor("vlp32c"), ("global",), (10.0,), FACE, ("0",), draws=2, jitter=False,
        removed_share=1 / 3, removal=removal,
    )  # fmt: skip
    rows = run_simulation(sweep, tmp_path / "part", estimator=centroid)
    whole = run_simulation(replace(sweep, removed_share=0.0), tmp_path / "whole", estimator=centroid)
    n = whole[0]["n_rings"]
    assert [row["n_rings"] for row in rows] == [n - round(n / 3)] * 2
    shift = rows[0]["error_tz"] - whole[0]["error_tz"]  # the mean of the returns goes up: the error goes down
    assert {"random": True, "lowest": shift < -0.05, "highest": shift > 0.05}[removal]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"draws": 0}, "at least one draw"),
        ({"noise": ("9",)}, "noise level '9'"),
        ({"removed_share": 1.0}, "share"),
        ({"distances": (-1.0,)}, "distance"),
    ],
)
def test_impossible_sweeps_are_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        SimulationSweep(TARGET, **wrong)
