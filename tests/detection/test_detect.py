"""Targets in full simulated scans: found, told apart, and not found where there are none."""

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import InputError, Scan, Target
from optshape_graph.detection import detect_targets
from optshape_graph.io import load_sensor, load_target
from optshape_graph.simulation import Box
from tests.detection.scenes import BOARD, only, pose, scan_of, shares

VLP32C, VLP16 = load_sensor("vlp32c"), load_sensor("vlp16")
PAPER, SQUARE, TRIANGLE = (load_target(f"{name}@1") for name in ("paper", "square", "triangle"))


def error_mm(found, T: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm(found.estimate.T_lidar_target[:3, 3] - T[:3, 3]))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("sensor", "target", "distance"), [(VLP32C, PAPER, 7.0), (VLP16, BOARD, 2.2)])
def test_found_with_its_returns(sensor, target: Target, distance: float, seed: int) -> None:
    """Nearly all returns and nearly no others; the pose is that of those returns (a centimetre at 7 m)."""
    T = pose(distance, 0.5, 0.1, 20, 10, 15)
    simulated = scan_of(sensor, [(target, T)], seed=seed)
    found = only(detect_targets(simulated.scan, [target]))
    mine, others = shares(found, simulated)
    assert mine >= 0.97
    assert others <= 0.01
    undoubted = found.indices[~found.doubtful]
    assert 0.85 < len(undoubted) / len(found.indices) < 1.0
    assert (simulated.surface[undoubted] == 0).all()
    assert found.status == "ok"
    assert found.target is target
    assert error_mm(found, T) < 15
    assert found.estimate.n_returns == pytest.approx(len(found.indices), abs=5)
    assert 0.7 < found.score <= 1.0


def test_across_the_seam_and_in_any_order() -> None:
    """The same scan turned about z by half a turn, and shuffled, gives the same returns."""
    simulated = scan_of(VLP32C, [(PAPER, pose(6, 0, 0.1, 20, 10, 15))], seed=1)
    scan = simulated.scan
    found = only(detect_targets(scan, [PAPER]))
    turned = replace(scan, points=scan.points * [-1.0, -1.0, 1.0])
    np.testing.assert_array_equal(only(detect_targets(turned, [PAPER])).indices, found.indices)
    order = np.random.default_rng(0).permutation(len(scan))
    shuffled = only(detect_targets(scan.select(order), [PAPER]))
    np.testing.assert_array_equal(np.sort(order[shuffled.indices]), found.indices)
    np.testing.assert_allclose(shuffled.estimate.T_lidar_target, found.estimate.T_lidar_target, atol=1e-9)


def test_sensor_unknown() -> None:
    T = pose(6, 0, 0.1, 20, 10, 15)
    scan = scan_of(VLP32C, [(PAPER, T)], seed=1).scan
    assert error_mm(only(detect_targets(Scan(scan.points, ring=scan.ring), [PAPER])), T) < 20


def test_none_where_there_is_none() -> None:
    scan = scan_of(VLP32C, [], Box(np.array([0.5, 0.5, 1.5]), pose(3, 3, -1))).scan
    assert detect_targets(scan, [PAPER, SQUARE]).found == ()


def test_several_of_several_shapes() -> None:
    placed = [
        (PAPER, pose(6, 0, 0.1, 20, 10, 15)),
        (TRIANGLE, pose(0.5, 7, 0, 15, 0, 80)),
        (PAPER, pose(-8, -1, 0.2, 70, 10, 190)),
    ]
    simulated = scan_of(VLP32C, placed)
    found = detect_targets(simulated.scan, [PAPER, SQUARE, TRIANGLE]).found
    assert len(found) == 3
    for k, (target, T) in enumerate(placed):
        (match,) = (one for one in found if error_mm(one, T) < 50)
        assert match.target is target
        assert shares(match, simulated, k)[0] > 0.95


@pytest.mark.parametrize("distance", [5.0, 9.0, 14.0])
@pytest.mark.parametrize("shape", [PAPER, TRIANGLE])
def test_told_apart(shape: Target, distance: float) -> None:
    """Shapes of one area: what is not the shape is turned down, or less likely by far."""
    simulated = scan_of(VLP32C, [(shape, pose(distance, 0, 0, 25, 10, -15))], seed=2)
    found = only(detect_targets(simulated.scan, [PAPER, SQUARE, TRIANGLE]))
    assert found.target is shape
    assert found.margin > 10


def test_nearly_equal_shapes_are_flagged() -> None:
    """Vertices that differ by 8 mm, at 12 m with a step of 42 mm: either may be named, neither as certain."""
    built = load_target("built@1")
    simulated = scan_of(VLP32C, [(PAPER, pose(12, 0, 0, 25, 10, -15))])
    found = only(detect_targets(simulated.scan, [PAPER, built]))
    assert found.status == "ambiguous"
    assert {found.target.name, found.rival.name} == {PAPER.name, built.name}
    assert set(found.probabilities) == {PAPER.name, built.name}
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    assert next(iter(found.probabilities)) == found.target.name
    assert np.log(found.probabilities[found.target.name] / found.probabilities[found.rival.name]) == pytest.approx(
        found.margin
    )
    assert f"'{PAPER.name}'" in found.reason
    assert f"'{built.name}'" in found.reason


def test_hung_before_a_wall() -> None:
    T = pose(6, 0, 0.1, 15, 0, 0)
    simulated = scan_of(VLP32C, [(PAPER, T)], Box(np.array([0.2, 8.0, 5.0]), pose(6.3, 0, 0.5)))
    found = only(detect_targets(simulated.scan, [PAPER]))
    assert shares(found, simulated)[0] > 0.97
    assert error_mm(found, T) < 15


def test_a_window_of_its_size_in_a_wall_is_none() -> None:
    """What bounds it stands before it: a wall with a hole, and a wall half a metre behind the hole."""
    frame = [
        Box(np.array([0.1, 4.0, 2.5]), pose(6, 0, z)) for z in (-1.75, 1.75)
    ] + [Box(np.array([0.1, 2.0, 1.0]), pose(6, y, 0)) for y in (-1.5, 1.5)]  # fmt: skip
    wall = Box(np.array([0.1, 5.0, 5.0]), pose(6.5, 0, 0))
    assert detect_targets(scan_of(VLP32C, [], wall, *frame).scan, [SQUARE]).found == ()


@pytest.mark.parametrize("seed", range(2))
def test_an_arm_in_its_plane_is_cut_off(seed: int) -> None:
    T = pose(2.5, 0, 0.1, 20, 10, 15)
    arm = Box(np.array([0.04, 0.6, 0.08]), T @ pose(0, 0.55, 0))
    simulated = scan_of(VLP16, [(BOARD, T)], arm, seed=seed)
    found = only(detect_targets(simulated.scan, [BOARD]))
    mine, others = shares(found, simulated)
    assert mine > 0.97
    assert others < 0.03
    assert error_mm(found, T) < 15


def test_rejections_say_why() -> None:
    scan = scan_of(VLP32C, [(BOARD, pose(5, 0, 0, 20, 0, 0))]).scan
    detections = detect_targets(scan, [load_target("paper@1")])
    assert detections.found == ()
    (one,) = (r for r in detections.rejected if np.linalg.norm(r.centre - [5, 0, 0]) < 0.3)
    assert "the target 1.00 m2" in one.reason
    assert one.area == pytest.approx(BOARD.area, rel=0.1)
    assert one.n_rings > 10


def test_a_target_alone_is_as_good_as_a_list() -> None:
    scan = scan_of(VLP32C, [(PAPER, pose(6, 0, 0.1, 20, 10, 15))]).scan
    alone, listed = only(detect_targets(scan, PAPER)), only(detect_targets(scan, [PAPER]))
    np.testing.assert_array_equal(alone.estimate.T_lidar_target, listed.estimate.T_lidar_target)


def test_bad_requests() -> None:
    scan = scan_of(VLP32C, []).scan
    with pytest.raises(InputError, match="expected a Target or a list of them, found str"):
        detect_targets(scan, "paper")
    with pytest.raises(InputError, match="expected a Target or a list of them, found int in the list"):
        detect_targets(scan, [PAPER, 1])
    with pytest.raises(InputError, match="no targets"):
        detect_targets(scan, [])
    with pytest.raises(InputError, match="different names"):
        detect_targets(scan, [PAPER, PAPER])
    with pytest.raises(InputError, match="expected a ring"):
        detect_targets(Scan(scan.points), [PAPER])
    empty = scan.select(np.zeros(len(scan), bool))
    assert detect_targets(empty, [PAPER]).found == ()


@pytest.mark.parametrize("target", [SQUARE, TRIANGLE, load_target("optimal5")], ids=lambda target: target.name)
def test_on_a_stand_whose_pole_is_in_the_plane(target: Target) -> None:
    """A pole below a level edge, as near to the plane as the noise, gives no ring to the target."""
    for seed in range(4):
        T = pose(6.0 + seed, 0.4 * seed - 0.6, 0.0, 0, 0, 15 - 10 * seed)
        pole = Box(np.array([0.05, 0.05, 1.8]), pose(*(T[:3, 3] + 0.05 * T[:3, 0] - [0, 0, 0.9])))
        found = only(detect_targets(scan_of(VLP32C, [(target, T)], pole, seed=seed).scan, [target]))
        assert found.status == "ok"
        sd = float(np.sqrt(found.estimate.covariance[3:, 3:].trace()))
        assert error_mm(found, T) < max(4e3 * sd, 10), seed


@pytest.mark.parametrize(
    ("shape", "sensor", "distance", "rpy"),
    [
        ("score-optimal5", "vlp32c", 8.0, (10, -10, 15)),
        ("score-optimal5", "vlp32c", 6.5, (-15, 5, -20)),
        ("score-optimal", "vlp32c", 7.0, (20, 10, 0)),
        ("score-optimal5", "os1-64", 5.0, (0, 15, -10)),
    ],
)
def test_a_sharp_tip_is_the_targets_own(shape: str, sensor: str, distance: float, rpy: tuple[float, ...]) -> None:
    """Rays that pass beside a tip are no reason to leave its rings out: at most the last lacks, and the pose is ok.

    The last ring has one to four returns; in eight of these twenty scans it is still lost. Of ends two standard
    deviations off by chance there may be too many for one of five scans to be sure.
    """
    target, unsure = load_target(shape), []
    for seed in range(5):
        simulated = scan_of(load_sensor(sensor), [(target, pose(distance, 0.3, 0.1 * seed, *rpy))], seed=seed)
        found = only(detect_targets(simulated.scan, [target]))
        assert found.estimate.status == "ok", found.reason
        unsure += [found.reason] * (found.status != "ok")
        ring = simulated.scan.ring
        assert ring is not None
        assert len(np.setdiff1d(ring[simulated.surface == 0], ring[found.indices])) <= 1
    assert len(unsure) <= 1, unsure


KITE = Target.from_polygon([[0.45, 0], [0, 0.38], [-0.62, 0.02], [0.02, -0.40]], "kite")
QUAD = Target.from_polygon([[0.7, 0.05], [0.1, 0.33], [-0.5, 0.12], [0.05, -0.45]], "quad")
"""Their outlines are 46 mm apart, root mean square, where they fit best, and 130 mm at most."""


@pytest.mark.parametrize("sensor", ["vlp32c", "os1-64"])
def test_another_shape_cut_to_the_outline(sensor: str) -> None:
    """A surface that goes on beyond the outline is not taken for the target; the target itself always is.

    Cut to the target, it would be taken for it in three of the ten scans of one sensor and in one of the other's.
    Where few rings meet what goes on beyond, one scan in ten may not tell.
    """
    taken, beyond = 0, 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        place = rng.uniform([2.5, -0.5, -0.1, -180, -25, -25], [4.5, 0.5, 0.2, 180, 25, 25])
        T = pose(*place)
        others = detect_targets(scan_of(load_sensor(sensor), [(QUAD, T)], seed=seed).scan, [KITE]).found
        taken += sum(one.status == "ok" for one in others)
        beyond += sum("goes on beyond its outline" in one.reason for one in others)
        post = Box(np.array([0.04, 0.04, 1.6]), pose(*(T[:3, 3] + [0.05, 0, -0.8])))
        own = only(detect_targets(scan_of(load_sensor(sensor), [(KITE, T)], post, seed=seed).scan, [KITE]))
        assert own.status == "ok", own.reason
        assert own.evidence.bounded == 1.0
    assert taken <= 1
    assert beyond >= 1
