"""Does the evidence mean what it says? The margin's probability of a wrong choice against the share that is wrong."""

import gtsam
import numpy as np
import pytest

from optshape_graph.evaluation.simulation import SimulationSweep, true_pose
from optshape_graph.io import load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.simulation import NoiseModel, simulate_target
from optshape_graph.simulation.reference import ORIENTATIONS, reference_sensor

pytestmark = pytest.mark.benchmark


@pytest.mark.parametrize("level", [0, 1, 3])
def test_share_of_wrong_choices(level):
    """200 scans at 26 to 40 m: the number of flipped poses within 3 standard deviations of what the margins predict."""
    target, rng = load_target("paper"), np.random.default_rng(7)
    sensor, noise = reference_sensor(), NoiseModel.level(level).jittered()
    wrong, said = 0, []
    for k in range(200):
        T = true_pose(SimulationSweep(target), tuple(ORIENTATIONS.values())[k % 2], rng.uniform(26, 40), rng)
        scan = simulate_target(target, sensor, T, noise=noise, rng=rng)
        estimate = estimate_pose(scan, target)
        turn = gtsam.Rot3.Logmap(gtsam.Rot3(T[:3, :3].T @ estimate.T_lidar_target[:3, :3]))
        flipped = bool(np.degrees(np.linalg.norm(turn)) > 60)
        wrong += flipped
        said.append(1 / (1 + np.exp(min(estimate.ambiguity.margin, 700.0))))
        assert not (flipped and estimate.status == "ok")
    p = np.array(said)
    print(f"\nlevel {level}: {wrong} of 200 wrong, {p.sum():.1f} said; {np.mean(p < 0.0067):.2f} above the margin")
    assert abs(wrong - p.sum()) <= 3 * np.sqrt((p * (1 - p)).sum()) + 1
