import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.evaluation.shape_study import TILT, random_placements, random_shapes, study_shapes
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target
from optshape_graph.runs.workers import Pool
from optshape_graph.viz.design import plot_study
from tests.viz.legible import assert_legible


def test_random_shapes_are_triangles_quadrilaterals_and_pentagons():
    shapes = random_shapes(9, seed=1, area=0.5)
    assert [len(shape) for shape in shapes] == [3, 4, 5] * 3
    for shape in shapes:
        assert shape.area == pytest.approx(0.5)
        assert shape.edge_lengths.min() >= 0.3 * np.sqrt(0.5)
    np.testing.assert_array_equal(random_shapes(9, seed=1, area=0.5)[4].vertices, shapes[4].vertices)


def test_placements_face_the_sensor_more_or_less():
    placements = random_placements([5.0, 10.0], 8, seed=0)
    assert placements.shape == (16, 4, 4)
    np.testing.assert_allclose(placements[:, 0, 3], np.repeat([5.0, 10.0], 8))
    # The target's x axis is within TILT of the sensor's.
    assert placements[:, 0, 0].min() >= np.cos(TILT) - 1e-9
    np.testing.assert_allclose(np.linalg.det(placements[:, :3, :3]), 1.0)


def test_study_is_repeatable_resumes_and_finds_small_errors(tmp_path):
    targets = [load_target("paper"), load_target("triangle"), *random_shapes(1, seed=2)]
    placements = random_placements([6.0], 3, seed=0)
    sensor = load_sensor("vlp32c")
    first = study_shapes(targets, sensor, placements, 0, tmp_path / "a")
    assert len(list((tmp_path / "a").glob("task-*.json"))) == 3
    again = study_shapes(targets, sensor, placements, 0, tmp_path / "a")
    fresh = study_shapes(targets, sensor, placements, 0, tmp_path / "b", pool=Pool(2))
    for a, b, c in zip(first.shapes, again.shapes, fresh.shapes, strict=True):
        np.testing.assert_array_equal(a.e_r, b.e_r)
        np.testing.assert_array_equal(a.e_r, c.e_r)
        assert (a.e_in_plane <= a.e_r + 1e-12).all()
        # At 6 m, with 1 cm of noise and bias: within a few bounds, modulo the triangle's symmetry.
        assert np.median(a.e_r) < 4 * np.median(a.bound_r)
    assert -1 <= first.correlation("score").rho <= 1
    summary = first.summary()
    assert [shape["name"] for shape in summary["shapes"]] == ["paper", "triangle", "random-0"]
    assert len(summary["correlations"]) == 4
    assert_legible(plot_study(first))
    with pytest.raises(InputError, match="another sweep"):
        study_shapes(targets, sensor, placements, 1, tmp_path / "a")
