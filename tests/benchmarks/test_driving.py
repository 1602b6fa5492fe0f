"""Maps and trajectories from simulated scans, taken on the move by a LiDAR that keeps its biases."""

from functools import cache

import numpy as np
import pytest

from optshape_graph.evaluation.trajectories import absolute_error, pose_nees, predicted_rmse, relative_error
from optshape_graph.mapping import Landmark, LandmarkSlam, Map, Start, solve_batch
from optshape_graph.se3 import inverse
from tests.factors.support import retract
from tests.mapping.driving import PAPER, Drive, beside, drive, kitti_path
from tests.mapping.support import at, covariance, loop

SEEDS = 20
SURVEY = covariance([0.01] * 6)


@cache
def around_the_loop(seed: int) -> Drive:
    world = loop(n_poses=250)
    return drive(world.poses, world.targets, seed)


@cache
def around_the_room(seed: int) -> Drive:
    """Three laps of 13 m inside six targets: each landmark is seen from all 90 poses or nearly."""
    angles = 6 * np.pi * np.arange(90) / 90
    poses = np.array([at(2 * np.sin(a), -2 * np.cos(a), a) for a in angles])
    targets = np.array([at(7 * np.cos(a), 7 * np.sin(a), a + 0.3, 0.2) for a in 2 * np.pi * np.arange(6) / 6])
    return drive(inverse(poses[0]) @ poses, inverse(poses[0]) @ targets, seed)


def survey(driven: Drive, seed: int) -> Map:
    noisy = [retract(T, 0.01 * np.random.default_rng([seed, j]).normal(size=6)) for j, T in enumerate(driven.targets)]
    return Map(tuple(Landmark(f"t{j}", PAPER, T, SURVEY) for j, T in enumerate(noisy)))


def solved(driven: Drive, seed: int, known: bool, ring_biases: bool = True) -> dict[str, float]:
    """Return squared errors, what marginals predict, and NEES per degree of freedom, of poses and of landmarks."""
    start = Start(driven.poses[0], 1e-8 * np.eye(6))
    slam = driven.feed(LandmarkSlam(survey(driven, seed) if known else None, start))
    solution = solve_batch(slam.problem(), ring_biases=ring_biases)
    numbers = list(range(5, len(driven.poses), 10))
    estimated, true = solution.trajectory("session").poses, driven.poses
    C = np.array([solution.covariance(poses=[("session", i)]) for i in numbers])
    names = list(solution.landmarks)
    found, targets = np.array(list(solution.landmarks.values())), driven.targets[[int(name[1:]) for name in names]]
    C_found = np.array([solution.covariance([name]) for name in names])

    running = slam.landmarks
    C_running = np.array([slam.covariance([name]) for name in running])
    true_running = driven.targets[[int(name[1:]) for name in running]]

    def square(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.square(a[:, :3, 3] - b[:, :3, 3]).sum(axis=1).mean())

    return {
        "error": square(estimated[numbers], true[numbers]),
        "predicted": predicted_rmse(C) ** 2,
        "nees": float(pose_nees(estimated[numbers], true[numbers], C).mean() / 6),
        "incremental": square(slam.trajectory.poses, true),
        "odometry": square(driven.dead_reckoning(), true),
        "landmark error": square(found, targets),
        "landmark predicted": predicted_rmse(C_found) ** 2,
        "landmark nees": float(pose_nees(found, targets, C_found).mean() / 6),
        "running nees": float(pose_nees(np.array(list(running.values())), true_running, C_running).mean() / 6),
    }


def mean_of(runs: list[dict[str, float]]) -> dict[str, float]:
    """Means over runs; of squares, their roots."""
    mean = {name: float(np.mean([run[name] for run in runs])) for name in runs[0]}
    return {name: value if name.endswith("nees") else float(np.sqrt(value)) for name, value in mean.items()}


def told(r: dict[str, float]) -> str:
    return (
        f"RMSE {r['error']:.3f} m, predicted {r['predicted']:.3f}, NEES/dof {r['nees']:.2f}; incremental "
        f"{r['incremental']:.3f}, odometry alone {r['odometry']:.2f}; landmarks {r['landmark error']:.4f} m, "
        f"predicted {r['landmark predicted']:.4f}, NEES/dof {r['landmark nees']:.2f}, incremental "
        f"{r['running nees']:.2f}"
    )


@pytest.mark.benchmark
@pytest.mark.parametrize("known", [False, True])
def test_loop_of_500_m_on_simulated_scans(known, capsys):
    result = mean_of([solved(around_the_loop(seed), seed, known) for seed in range(SEEDS)])
    with capsys.disabled():
        print(f"\n500 m on scans, {SEEDS} seeds, landmarks {'surveyed' if known else 'unknown'}: {told(result)}")
    assert result["error"] <= 1.2 * result["predicted"]
    assert 0.8 <= result["nees"] <= 1.25


@pytest.mark.benchmark
def test_a_room_seen_by_a_lidar_that_keeps_its_errors(capsys):
    drives = [around_the_room(seed) for seed in range(SEEDS)]
    plain, biased = (
        mean_of([solved(driven, seed, False, wanted) for seed, driven in enumerate(drives)]) for wanted in (False, True)
    )
    with capsys.disabled():
        print(f"\nroom, {SEEDS} seeds, each match's own: {told(plain)}\n  biases of the LiDAR's: {told(biased)}")
    assert biased["landmark error"] < plain["landmark error"]
    assert biased["landmark nees"] <= 1.25
    assert biased["running nees"] <= 1.25


@pytest.mark.benchmark
def test_a_real_path(capsys):
    path = kitti_path()
    runs = []
    for seed in range(5):
        driven = drive(path, beside(path, 12), seed)
        estimated = solve_batch(driven.feed(LandmarkSlam()).problem()).trajectory("session").poses
        over = relative_error(estimated, path, 20.0)
        runs.append([
            absolute_error(estimated, path).translation.rmse,
            absolute_error(driven.dead_reckoning(), path).translation.rmse,
            over.translation.rmse,
            np.degrees(over.rotation.rmse),
        ])  # fmt: skip
    ate, dead, moved, turned = np.sqrt(np.mean(np.square(runs), axis=0))
    with capsys.disabled():
        print(
            f"\nKITTI 00, 110 m, 11 targets, 5 seeds: ATE {ate:.3f} m (odometry alone {dead:.3f}); over 20 m "
            f"{moved:.3f} m and {turned:.2f} deg"
        )
    assert ate < 0.3 * dead
