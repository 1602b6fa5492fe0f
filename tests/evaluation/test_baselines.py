import numpy as np
import pytest

from optshape_graph import EstimationError
from optshape_graph.evaluation.baselines import icp_to_template, ransac_corners
from optshape_graph.evaluation.metrics import pose_error
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target
from optshape_graph.simulation import pose_from_rpy, simulate_target


@pytest.mark.parametrize("method", [ransac_corners, icp_to_template])
@pytest.mark.parametrize("name", ["paper", "pose-optimal"])
def test_dense_scans_without_noise_are_found(method, name):
    """Near, with many rings: a fair copy of either method is right to a couple of degrees and centimetres."""
    target = load_target(name)
    T = pose_from_rpy([4.0, 0.2, 0.0], [0.1, 0.2, -0.1])
    scan = simulate_target(target, load_sensor("os1-128"), T, rng=np.random.default_rng(0))
    error = pose_error(target, method(scan, target), T)
    assert np.degrees(error.e_r) < 3.0
    assert error.e_t < 0.03


def test_too_few_rings_are_said():
    target = load_target("paper")
    T = pose_from_rpy([30.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    scan = simulate_target(target, load_sensor("vlp16"), T, rng=np.random.default_rng(0))
    with pytest.raises(EstimationError, match="edge points make no 4 lines"):
        ransac_corners(scan, target)
