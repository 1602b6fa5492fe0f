"""The picture of a factor graph counts and places what is in it."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, X

pytest.importorskip("matplotlib")

from optshape_graph.mapping import factor_graph
from optshape_graph.viz.graph import plot_graph
from tests.mapping.support import loop
from tests.mapping.test_batch import problem_of
from tests.viz.legible import assert_legible


def test_a_map_s_graph():
    problem = problem_of(loop(length=100.0, n_poses=20, n_targets=5), 0)
    graph, values = factor_graph(problem)
    figure = plot_graph(graph, values)
    assert_legible(figure)
    axes = figure.axes[0]
    unlike, alike = axes.collections
    assert len(unlike.get_segments()) == len(problem.tracks[0].matches)
    assert len(alike.get_segments()) == 19
    assert axes.get_title().startswith(f"25 variables, {graph.size()} factors")


def test_factors_on_three_variables_names_and_variables_without_a_place():
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
    values.insert(X(0), gtsam.Pose3())
    values.insert(L(0), gtsam.Pose3(gtsam.Rot3(), [2.0, 0.0, 0.0]))
    values.insert(L(1), np.array([0.0, 2.0, 0.0]))
    values.insert(B(0), 0.5)
    graph.push_back(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), noise))
    graph.push_back(gtsam.BetweenFactorPose3(X(0), L(0), gtsam.Pose3(), noise))
    graph.push_back(
        gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [X(0), L(0), L(1)], lambda this, v, H: np.zeros(1))
    )
    figure = plot_graph(graph, values, {X(0): "start"})
    assert_legible(figure)
    axes = figure.axes[0]
    assert len(axes.collections[0].get_segments()) == 1 + 3
    assert "start" in [text.get_text() for text in axes.texts]
    assert "1 variables without a place" in [text.get_text() for text in figure.legends[0].get_texts()]
    assert axes.get_title() == "4 variables, 3 factors: 1 between two, 1 on more, 1 on one"
