"""The target: its frame, edges and symmetries, and the polygons that are none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError, Target
from optshape_graph.io import load_target


def regular(n: int, radius: float = 0.5, turn: float = 0.1) -> Target:
    angles = 2 * np.pi * np.arange(n) / n + turn
    return Target.from_polygon(radius * np.column_stack([np.cos(angles), np.sin(angles)]), f"{n}-gon")


@pytest.mark.parametrize("n", [3, 4, 5, 6, 12])
def test_regular_polygons_have_n_symmetries(n: int) -> None:
    target = regular(n)
    np.testing.assert_allclose(target.symmetries, 2 * np.pi * np.arange(n) / n, atol=1e-9)
    for S in target.symmetry_rotations:
        turned = target.vertices @ S.T
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
