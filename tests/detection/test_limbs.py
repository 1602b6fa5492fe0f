"""What sticks out of a convex outline is cut, and nothing of the outline is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optshape_graph.detection.limbs import without_limbs
from optshape_graph.detection.segments import sweep
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose.association import fit_plane
from optshape_graph.simulation import Box, NoiseModel, Patch, Scene, simulate, simulate_target
from tests.detection.scenes import BOARD, pose

VLP16, VLP32C = load_sensor("vlp16"), load_sensor("vlp32c")


@settings(max_examples=25, deadline=None)
@given(
    roll=st.floats(0, 360), tilt=st.floats(-30, 30), turn=st.floats(-40, 40), seed=st.integers(0, 1000),
    name=st.sampled_from(["paper@1", "square@1", "triangle@1"]),
)  # fmt: skip
def test_a_convex_outline_has_none(roll: float, tilt: float, turn: float, seed: int, name: str) -> None:
    scan = simulate_target(
        load_target(name), VLP32C, pose(6, 0, 0, roll, tilt, turn), noise=NoiseModel.of(VLP32C), rng=seed
    )
    ordered = sweep(scan)
    rows = np.arange(len(ordered))
    assert without_limbs(ordered, rows, fit_plane(ordered.points, ordered.ring)).mean() > 0.99


@pytest.mark.parametrize("side", [-1, 1])
def test_an_arm(side: int) -> None:
    T = pose(2.5, 0, 0, 15, 0, 0)
    scene = Scene((Patch(BOARD, T),), (Box(np.array([0.02, 0.5, 0.08]), T @ pose(0, side * 0.56, 0)),))
    simulated = simulate(scene, VLP16, noise=NoiseModel.of(VLP16))
    ordered = sweep(simulated.scan)
    keep = without_limbs(ordered, np.arange(len(ordered)), fit_plane(ordered.points, ordered.ring))
    of_arm = simulated.surface[ordered.index] == 1
    beyond = of_arm & (np.abs(ordered.points[:, 1]) > 0.5)
    assert beyond.sum() > 20
    assert not keep[beyond].any()
    assert keep[~of_arm].mean() > 0.9  # what is cut of the board comes back with its pose
