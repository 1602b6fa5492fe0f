"""The target: its frame, edges and symmetries, and the polygons that are none."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError, Target
from optshape_graph.io import load_target
from optshape_graph.se3 import apply, exp
from optshape_graph.target import Tags


def regular(n: int, radius: float = 0.5, turn: float = 0.1) -> Target:
    angles = 2 * np.pi * np.arange(n) / n + turn
    return Target.from_polygon(radius * np.column_stack([np.cos(angles), np.sin(angles)]), f"{n}-gon")


@pytest.mark.parametrize("n", [3, 4, 5, 6, 12])
def test_regular_polygons_have_n_symmetries(n: int) -> None:
    target = regular(n)
    np.testing.assert_allclose(target.symmetries, 2 * np.pi * np.arange(n) / n, atol=1e-9)
    np.testing.assert_array_equal(target.symmetry_transforms[0], np.eye(4))
    for turned in apply(target.symmetry_transforms, target.vertices):
        gaps = np.linalg.norm(turned[:, None] - target.vertices[None], axis=-1).min(axis=1)
        assert gaps.max() < 1e-9


@pytest.mark.parametrize(
    ("name", "count"), [("paper", 1), ("built", 1), ("square", 4), ("triangle", 3), ("diamond", 4)]
)
def test_built_in_targets(name: str, count: int) -> None:
    assert len(load_target(name).symmetries) == count


def test_a_rectangle_has_two() -> None:
    assert len(Target.from_polygon([[0.3, -0.4], [0.3, 0.4], [-0.3, 0.4], [-0.3, -0.4]]).symmetries) == 2


@given(st.integers(3, 9), st.floats(0.05, 5), st.floats(0, 6))
def test_edges(n: int, radius: float, turn: float) -> None:
    target = regular(n, radius, turn)
    following = np.roll(target.polygon, -1, axis=0)
    for k in range(n):
        # Both ends of edge k satisfy its line; every vertex is inside; the normal points out.
        assert target.normals[k] @ target.polygon[k] == pytest.approx(target.offsets[k], abs=1e-9 * radius)
        assert target.normals[k] @ following[k] == pytest.approx(target.offsets[k], abs=1e-9 * radius)
        assert (target.polygon @ target.normals[k] <= target.offsets[k] + 1e-9 * radius).all()
    np.testing.assert_allclose(target.edge_lengths, 2 * radius * np.sin(np.pi / n), rtol=1e-9)
    assert target.area == pytest.approx(0.5 * n * radius**2 * np.sin(2 * np.pi / n))
    assert target.circumradius == pytest.approx(radius)
    assert target.contains([[0.0, 0.0]])[0]
    assert not target.contains([[2 * radius, 0.0]])[0]


@given(st.floats(0.1, 20))
def test_scaling(area: float) -> None:
    scaled = load_target("paper").scaled_to_area(area)
    assert scaled.area == pytest.approx(area)
    np.testing.assert_allclose(scaled.normals, load_target("paper").normals)


@given(st.integers(3, 7), st.integers(0, 2**32 - 1))
def test_equivalent_poses_are_named_as_predicted(n: int, seed: int) -> None:
    target, rng = regular(n), np.random.default_rng(seed)
    T, moved = (exp(rng.normal(size=(2, 5, 6))) for _ in range(2))
    k = rng.integers(n, size=(2, 5))
    # Named otherwise and turned by less than half of the symmetry's angle, the pose is recognised.
    predicted = T @ target.symmetry_transforms[k] @ exp(0.4 * np.pi / n * np.eye(6)[rng.integers(6, size=(2, 5))])
    np.testing.assert_array_equal(target.nearest_symmetry(T, predicted), k)
    np.testing.assert_allclose(target.nearest_equivalent(T, predicted), T @ target.symmetry_transforms[k], atol=1e-12)
    # The frame that poses are in does not matter.
    np.testing.assert_array_equal(target.nearest_symmetry(moved @ T, moved @ predicted), k)


def test_targets_are_equal_by_value() -> None:
    for name in ("paper", "square"):
        a, b = load_target(name), load_target(name)
        assert a == b
        assert hash(a) == hash(b)
    assert load_target("paper") != load_target("built")
    assert load_target("paper") != load_target("paper").scaled(1.01)
    assert load_target("paper") != Target(load_target("paper").vertices, "other")
    tagged = [Target(regular(4).vertices, tags=Tags("4X4_50", 0.1, centres)) for centres in ({1: (0, 0)}, {2: (0, 0)})]
    assert tagged[0] != tagged[1]
    assert len({*tagged, Target(regular(4).vertices, tags=Tags("4X4_50", 0.1, {1: (0, 0)}))}) == 2
    assert regular(4) != "4-gon"


def test_a_target_prints_as_one_line() -> None:
    assert repr(load_target("paper@0.5")) == "Target('paper@0.5', 4 vertices, 1.13 x 0.758 m)"


def test_copies_stay_read_only() -> None:
    target = load_target("paper")
    for other in (pickle.loads(pickle.dumps(target)), copy.deepcopy(target), copy.copy(target)):
        assert other == target
        assert not other.vertices.flags.writeable


def test_arrays_are_read_only() -> None:
    with pytest.raises(ValueError, match="read-only"):
        load_target("paper").vertices[0, 1] = 3.0


@pytest.mark.parametrize(
    ("yz", "message"),
    [
        ([[0.5, 0], [-0.5, 0]], "do not close"),
        ([[0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]], "clockwise"),
        ([[0.5, -0.5], [0.5, 0.5], [0.0, 0.0], [-0.5, 0.5], [-0.5, -0.5]], "convex"),
        ([[0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]], "coincide"),
        ([[1.0, 0.0], [0.0, 0.0], [-1.0, 0.0]], "convex"),
        ([[500.0, -500], [500, 500], [-500, 500], [-500, -500]], "millimetres"),
        ([[np.nan, 0], [1, 0], [0, 1]], "finite"),
        ([[1e-6, -1e-6], [1e-6, 1e-6], [-1e-6, 0]], "some size"),
        ([[0.0, 1.0], [-0.6, -0.8], [0.95, 0.3], [-0.95, 0.3], [0.6, -0.8]], "convex"),
    ],
)
def test_what_is_no_target(yz: list[list[float]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Target.from_polygon(yz, "bad")


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (np.zeros((4, 2)), "n x 3"),
        (np.array([[0.1, 0.5, -0.5], [0, 0.5, 0.5], [0, -0.5, 0.5], [0, -0.5, -0.5]]), "plane x = 0"),
        (np.array([[0, 1.5, -0.5], [0, 1.5, 0.5], [0, 0.5, 0.5], [0, 0.5, -0.5]]), "subtract"),
    ],
)
def test_what_is_not_in_the_target_frame(vertices: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Target(vertices)


@pytest.mark.parametrize("factor", [0.0, -1.0, np.nan, np.inf])
def test_impossible_scales(factor: float) -> None:
    for scale in (load_target("paper").scaled, load_target("paper").scaled_to_area):
        with pytest.raises(InputError, match="positive"):
            scale(factor)
