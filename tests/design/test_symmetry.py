import numpy as np
import pytest

from optshape_graph.design.family import Family
from optshape_graph.design.symmetry import nearest_self_rotation, radii


@pytest.mark.parametrize("sides", [3, 4, 5, 6, 8])
def test_regular_polygons_cover_themselves(sides):
    found = nearest_self_rotation(Family(sides).nominal)
    assert found.distance < 1e-12
    assert found.angle % (2 * np.pi / sides) == pytest.approx(0.0, abs=1e-9)


def test_a_rectangle_covers_itself_after_half_a_turn():
    rectangle = np.array([[2.0, 0.5], [-2.0, 0.5], [-2.0, -0.5], [2.0, -0.5]])
    found = nearest_self_rotation(rectangle)
    assert found.distance < 1e-12
    assert found.angle == pytest.approx(np.pi)


def test_distance_is_the_area_that_is_uncovered():
    """A right isosceles triangle after half a turn: the overlap of a triangle and its point reflection is 2/3 of it."""
    triangle = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    from optshape_graph.design.symmetry import self_distances

    # 1440 directions: trapezoidal error of the kinks.
    assert self_distances(triangle, 1440)[720] == pytest.approx(1 / 3, abs=1e-4)


def test_it_does_not_depend_on_placement_or_size():
    polygon = Family(4).polygons([2.9656, 0.0240, 0.7546, 0.2946, 0.3483])[0]
    here, there = nearest_self_rotation(polygon), nearest_self_rotation(3 * polygon + [5.0, -2.0])
    assert here.distance == pytest.approx(there.distance, abs=1e-9)
    assert 0.1 < here.distance < 0.2


def test_radii_reach_the_outline():
    square = Family(4).nominal
    found = radii(square, 8)
    np.testing.assert_allclose(found, 0.5 * np.where(np.arange(8) % 2, np.sqrt(2), 1.0))
