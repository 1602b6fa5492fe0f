"""Candidates: the size of polygons against numbers drawn from them, and what sticks out of an outline."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optshape_graph import Target
from optshape_graph.detection import DetectionOptions
from optshape_graph.detection.candidates import Size, without_limbs
from optshape_graph.detection.segments import order_scan
from optshape_graph.io import load_sensor, load_target
from optshape_graph.plane import fit_plane
from optshape_graph.simulation import Box, NoiseModel, Patch, Scene, simulate, simulate_target
from tests.detection.scenes import BOARD, pose

VLP16, VLP32C = load_sensor("vlp16"), load_sensor("vlp32c")
OPTIONS = DetectionOptions()


@pytest.mark.parametrize("name", ["paper", "built", "square", "triangle", "diamond"])
def test_spread_is_that_of_the_area(name: str) -> None:
    """Against 200,000 uniform points: their standard deviations are known to 0.3 %."""
    target = load_target(name)
    reach = target.circumradius
    points = np.random.default_rng(0).uniform(-reach, reach, (600_000, 2))
    inside = points[target.contains(points)]
    expected = np.sqrt(np.linalg.eigvalsh(np.cov(inside.T)))
    np.testing.assert_allclose(Size.of(target).spread, expected, rtol=0.01)
    assert Size.of(target).area == pytest.approx(4 * reach**2 * len(inside) / len(points), rel=0.01)


def test_a_rectangle() -> None:
    size = Size.of(Target.from_polygon([[0, 0], [3, 0], [3, 4], [0, 4]]))
    assert size.area == pytest.approx(12.0)
    assert size.diameter == pytest.approx(5.0)
    assert size.width == pytest.approx(3.0)
    np.testing.assert_allclose(size.spread, np.array([3.0, 4.0]) / np.sqrt(12))


@pytest.mark.parametrize("angle", [0.3, 1.2, 2.9])
def test_no_rotation_changes_it(angle: float) -> None:
    target = load_target("paper")
    c, s = np.cos(angle), np.sin(angle)
    turned = Size.of(Target.from_polygon(target.polygon @ [[c, s], [-s, c]]))
    for field, value in vars(Size.of(target)).items():
        np.testing.assert_allclose(getattr(turned, field), value, rtol=1e-9)


@settings(max_examples=25, deadline=None)
@given(
    roll=st.floats(0, 360), tilt=st.floats(-30, 30), turn=st.floats(-40, 40), seed=st.integers(0, 1000),
    name=st.sampled_from(["paper@1", "square@1", "triangle@1"]),
)  # fmt: skip
def test_a_convex_outline_has_no_limbs(roll: float, tilt: float, turn: float, seed: int, name: str) -> None:
    scan = simulate_target(
        load_target(name), VLP32C, pose(6, 0, 0, roll, tilt, turn), noise=NoiseModel.of(VLP32C), rng=seed
    )
    ordered = order_scan(scan, OPTIONS)
    rows = np.arange(len(ordered))
    assert without_limbs(ordered, rows, fit_plane(ordered.points, ordered.ring)).mean() > 0.99


@pytest.mark.parametrize("side", [-1, 1])
def test_an_arm_is_a_limb(side: int) -> None:
    T = pose(2.5, 0, 0, 15, 0, 0)
    scene = Scene((Patch(BOARD, T),), (Box(np.array([0.02, 0.5, 0.08]), T @ pose(0, side * 0.56, 0)),))
    simulated = simulate(scene, VLP16, noise=NoiseModel.of(VLP16))
    ordered = order_scan(simulated.scan, OPTIONS)
    keep = without_limbs(ordered, np.arange(len(ordered)), fit_plane(ordered.points, ordered.ring))
    of_arm = simulated.surface[ordered.index] == 1
    beyond = of_arm & (np.abs(ordered.points[:, 1]) > 0.5)
    assert beyond.sum() > 20
    assert not keep[beyond].any()
    assert keep[~of_arm].mean() > 0.9  # what is cut of the board comes back with its pose
