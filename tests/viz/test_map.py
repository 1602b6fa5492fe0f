"""The map and the graph draw what they hold."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from optshape_graph.mapping import Landmark, Map
from optshape_graph.viz.map import plot_map, plot_structure
from tests.factors.support import TARGET
from tests.mapping.support import at, covariance, loop
from tests.mapping.test_batch import problem_of
from tests.viz.legible import assert_legible


def test_landmarks_and_ellipses_are_where_they_belong():
    T = at(3.0, 4.0, 0.5)
    C = covariance([0.1, 0.1, 0.1, 0.2, 0.1, 0.1])
    figure = plot_map(Map((Landmark("a", TARGET, T, C),)))
    outline, ellipse, low, facing, high = (line.get_xydata() for line in figure.axes[0].lines)
    np.testing.assert_allclose(outline[:-1], (TARGET.vertices @ T[:3, :3].T + T[:3, 3])[:, :2])
    # Three standard deviations: 0.6 m along the target's normal, 0.3 m across.
    radii = np.linalg.norm(ellipse - T[:2, 3], axis=1)
    assert radii.max() == pytest.approx(0.6, rel=1e-2)
    assert radii.min() == pytest.approx(0.3, rel=1e-2)
    # To the side that the LiDAR sees, and three standard deviations of the heading to both sides.
    along = np.array([end[1] - end[0] for end in (low, facing, high)])
    np.testing.assert_allclose(along[1] / np.linalg.norm(along[1]), -T[:2, 0] / np.linalg.norm(T[:2, 0]), atol=1e-9)
    turns = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
    np.testing.assert_allclose(np.diff(turns), 0.3, rtol=1e-6)
    assert_legible(figure)


def test_structure_has_a_line_for_every_factor():
    problem = problem_of(loop(length=100.0, n_poses=20, n_targets=5), 0)
    figure = plot_structure(problem)
    seen, moved = figure.axes[0].collections
    assert len(seen.get_segments()) == len(problem.tracks[0].matches)
    assert len(moved.get_segments()) == 19
    assert_legible(figure)


def test_small_ellipses_are_drawn_larger_and_it_says_so():
    C = covariance([0.001] * 6)
    landmarks = tuple(Landmark(name, TARGET, at(x, 0.0, 0.5), C) for name, x in (("a", 0.0), ("b", 10.0)))
    figure = plot_map(Map(landmarks))
    assert "drawn 100 times too large" in figure.axes[0].get_title()
    loop = figure.axes[0].lines[1].get_xydata()
    assert np.linalg.norm(loop - [0.0, 0.0], axis=1).max() == pytest.approx(100 * 3 * 0.001, rel=1e-2)
