"""Motion from the scans themselves: whether there is any, what KISS-ICP makes of it, and what is said without it."""

import builtins
from itertools import pairwise

import numpy as np
import pytest

from optshape_graph.errors import MissingExtraError
from optshape_graph.io import load_sensor, load_target, write_scan
from optshape_graph.io.recordings.stream import Stamped
from optshape_graph.mapping import map_recording
from optshape_graph.mapping.registration import moves, scan_odometry, unknown_motion
from optshape_graph.runs.workers import Pool
from optshape_graph.se3 import difference, exp, inverse
from optshape_graph.simulation import Box, ConstantTwist, NoiseModel, Patch, Scene, simulate
from tests.mapping.support import at

SENSOR, TARGET = load_sensor("vlp16"), load_target("paper")
TWIST = np.array([0.0, 0.0, 0.5, 0.8, 0.0, 0.0])
WHERE = [at(5.5, 1.5, 0.3, 0.1), at(-4.0, 4.0, 2.5, 0.1)]


@pytest.fixture(scope="module")
def revolutions():
    """A second of a VLP-16 that drives a circle in a room with two targets."""
    scene = Scene(tuple(Patch(TARGET, T) for T in WHERE), (Box(np.array([18.0, 17.0, 4.0]), at(0.5, 1.0, 0.0, 0.6)),))
    noise = NoiseModel.of(SENSOR)
    bias = noise.draw_range_bias(SENSOR.n_rings, np.random.default_rng(0))
    return [
        Stamped(0.1 * k, simulate(scene, SENSOR, ConstantTwist(exp(0.1 * k * TWIST), TWIST), **noisy).scan)
        for k, noisy in enumerate({"noise": noise, "rng": k, "range_bias": bias} for k in range(10))
    ]


def test_scans_tell_whether_the_lidar_moves(revolutions):
    assert moves(revolutions)
    noise, scene = NoiseModel.of(SENSOR), Scene((), (Box(np.array([18.0, 17.0, 4.0]), at(0.5, 1.0, 0.0, 0.6)),))
    still = [Stamped(0.1 * k, simulate(scene, SENSOR, np.eye(4), noise=noise, rng=k).scan) for k in range(5)]
    assert not moves(still)
    assert not moves([Stamped(10.0 * scan.stamp, scan.value) for scan in revolutions])  # a second apart: placements
    assert not moves(revolutions[:1])


def test_scans_are_registered_to_each_other(revolutions):
    pytest.importorskip("kiss_icp")
    poses = list(scan_odometry(revolutions))
    assert len(poses) == 11  # also at the beginning of the first scan
    assert poses[0].stamp == pytest.approx(-0.05, abs=1e-3)
    for a, b in pairwise(poses):
        error = difference(exp((b.stamp - a.stamp) * TWIST), inverse(a.value) @ b.value)
        assert np.degrees(np.linalg.norm(error[:3])) < 2.0
        assert np.linalg.norm(error[3:]) < 0.06


def test_without_the_library_it_is_said_and_in_the_covariances(revolutions, tmp_path, monkeypatch):
    real = builtins.__import__

    def absent(name, *arguments, **options):
        if name.startswith("kiss_icp"):
            raise ImportError(f"No module named '{name}'")
        return real(name, *arguments, **options)

    for k, scan in enumerate(revolutions):
        write_scan(tmp_path / f"{k}.pcd", scan.value)
    (tmp_path / "timestamps.txt").write_text("".join(f"{scan.stamp:.6f}\n" for scan in revolutions))
    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(MissingExtraError, match=r"optshape-graph\[icp\]"):
        list(scan_odometry(revolutions))
    result = map_recording(tmp_path, TARGET, SENSOR, pool=Pool(1))
    assert any("the LiDAR moves" in text and "[icp]" in text for text in result.warnings)
    for landmark in result.map.landmarks:
        error = min(
            (difference(landmark.T_world_target, T) for T in WHERE), key=lambda xi: float(np.linalg.norm(xi[3:]))
        )
        # 99.9 % of chi-square with 6 degrees of freedom.
        assert error @ np.linalg.solve(landmark.covariance, error) < 22.5
    # A target that passes 40 ms after the stamp: 20 mrad and 40 mm, standard deviations.
    np.testing.assert_allclose(np.sqrt(np.diag(unknown_motion(1).uncertainty(0.0, 0.04))), [0.02] * 3 + [0.04] * 3)
