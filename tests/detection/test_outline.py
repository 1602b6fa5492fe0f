"""An outline laid over the ends of rings: where it comes to lie, and what it fits better than."""

import numpy as np
import pytest

from optshape_graph import Target
from optshape_graph.detection import DetectionOptions
from optshape_graph.detection.candidates import Size, grow
from optshape_graph.detection.outline import Boundary, first_looks, look_again, rectangle_log_odds
from optshape_graph.detection.patches import find_patches
from optshape_graph.detection.segments import OrderedScan, order_scan
from optshape_graph.io import load_sensor, load_target
from tests.detection.scenes import plain, pose, scan_of

VLP32C = load_sensor("vlp32c")
PAPER, SQUARE, TRIANGLE = (load_target(f"{name}@1") for name in ("paper", "square", "triangle"))


def rolled(degrees: float) -> np.ndarray:
    return pose(6, 0.4, 0.1, 0, 10, 20) @ pose(0, 0, 0, degrees, 0, 0)


def surface(target: Target, T: np.ndarray, seed: int):
    ordered = order_scan(scan_of(plain(VLP32C), [(target, T)], seed=seed).scan, DetectionOptions())
    size = Size.of(target)
    (patch,) = (p for p in find_patches(ordered, 0.2 * size.width, 1.1 * size.diameter) if p.n_rings > 8)
    (candidate,) = grow(ordered, [patch], 1.5 * size.diameter)
    return ordered, candidate, Boundary.of(ordered, candidate.ends, candidate.plane)


@pytest.mark.parametrize("target", [PAPER, TRIANGLE], ids=lambda target: target.name)
@pytest.mark.parametrize("roll", [0.0, 75.0, 200.0])
def test_a_first_look_finds_the_pose(target: Target, roll: float) -> None:
    """Within a centimetre and two degrees in the plane: a third of a step at 6 m, and that over the half size."""
    for seed in range(3):
        T = rolled(roll)
        _, candidate, boundary = surface(target, T, seed)
        look = first_looks([boundary], [candidate.centroid], [target])[0]
        off = np.linalg.inv(T) @ look.T_lidar_target
        turns = [np.linalg.norm(off[1:3, 1:3] - S[1:3, 1:3]) for S in target.symmetry_transforms]
        assert np.linalg.norm(off[1:3, 3]) < 0.01
        assert min(turns) < np.sqrt(2) * np.radians(2)
        assert look.edged > 0.9


def test_a_mirrored_target_is_another_shape() -> None:
    """Its odds are worse by far more than chance, though area and spread are the same."""
    mirrored = Target.from_polygon(PAPER.polygon[::-1] * [-1.0, 1.0], "mirrored")
    _, candidate, boundary = surface(PAPER, rolled(30), 0)
    looks = [first_looks([boundary], [candidate.centroid], [target])[0] for target in (PAPER, mirrored)]
    assert looks[0].log_odds > looks[1].log_odds + 30
    assert looks[1].edged < looks[0].edged - 0.1


def test_a_board_that_blooms_is_shifted() -> None:
    """A target drawn 15 mm too small on all sides is as well fitted, and the shift says by how much."""
    _, candidate, boundary = surface(PAPER, rolled(30), 1)
    exact = first_looks([boundary], [candidate.centroid], [PAPER])[0]
    inner = np.array([
        np.linalg.solve(PAPER.normals[[k - 1, k]], PAPER.offsets[[k - 1, k]] - 0.015) for k in range(len(PAPER))
    ])  # fmt: skip
    small = first_looks([boundary], [candidate.centroid], [Target.from_polygon(inner, "small")])[0]
    assert small.edged > 0.9
    assert small.shift - exact.shift == pytest.approx(0.015, abs=0.003)


def test_looking_again_from_nearby_finds_the_same() -> None:
    _, candidate, boundary = surface(PAPER, rolled(30), 2)
    look = first_looks([boundary], [candidate.centroid], [PAPER])[0]
    again = look_again([boundary], [PAPER], [look.T_lidar_target @ pose(0, 0.01, 0.005, 1, 0, 0)])[0]
    np.testing.assert_allclose(again.T_lidar_target, look.T_lidar_target, atol=2e-3)
    assert again.log_odds == pytest.approx(look.log_odds, abs=0.5)


def test_against_a_rectangle() -> None:
    """A kite beats any rectangle by odds of a thousand; a square neither beats nor is beaten; a rectangle beats it."""
    board = Target.from_polygon([[0, 0], [0.85, 0], [0.85, 1.15], [0, 1.15]], "board")
    gains = []
    for target, template in ((PAPER, PAPER), (SQUARE, SQUARE), (board, SQUARE)):
        _, candidate, boundary = surface(target, rolled(25), 0)
        look = first_looks([boundary], [candidate.centroid], [template])[0]
        gains.append(look.log_odds - rectangle_log_odds([boundary], np.array([template.circumradius]))[0])
    kite, square, other = gains
    assert kite > np.log(1000)
    assert abs(square) < 5
    assert other < -5


def test_ends_that_are_hidden_are_left_out() -> None:
    ordered, candidate, _ = surface(PAPER, rolled(30), 0)
    assert isinstance(ordered, OrderedScan)
    hidden = np.zeros(2 * candidate.n_rings, bool)
    hidden[:5] = True
    assert len(Boundary.of(ordered, candidate.ends, candidate.plane, hidden).sd) == 2 * candidate.n_rings - 5
