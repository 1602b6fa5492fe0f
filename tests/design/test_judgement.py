import numpy as np
import pytest

from optshape_graph.design.judgement import SIX_ROTATIONS, judge, unit_area, worst_cell
from optshape_graph.design.polygons import areas, centroids
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target


def test_judgement_of_the_published_shape():
    found = judge(load_target("paper"), load_sensor("vlp32c"), 10.0)
    # About the area's centroid; 0.0157 is about the crossing of the diagonals. The built-in's vertices have six digits.
    assert found.six_rotations == pytest.approx(0.0173, rel=5e-3)
    assert found.every_degree == pytest.approx(0.0122, rel=5e-3)
    assert found.every_tenth <= found.every_degree
    assert found.self_rotation.distance > 0.1
    assert 0 < found.bound.e_t[0] <= found.bound.e_t[1] < 0.02


def test_size_and_placement_do_not_matter_to_the_score():
    small, large = (worst_cell(load_target(f"paper@{area}"), SIX_ROTATIONS) for area in (0.1, 3.0))
    assert small.score == pytest.approx(large.score, rel=1e-9)
    assert (small.orientation, small.area) == (large.orientation, large.area)


def test_unit_area_is_about_the_centroid():
    polygon = unit_area(load_target("built"))
    assert areas(polygon) == pytest.approx(1.0)
    np.testing.assert_allclose(centroids(polygon), 0.0, atol=1e-12)
