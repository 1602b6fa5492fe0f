import pytest

from optshape_graph.design.judgement import judge
from optshape_graph.design.multistart import search
from optshape_graph.design.problem import Problem
from optshape_graph.design.rings import UniformRings
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target
from optshape_graph.viz import design as viz
from optshape_graph.viz.style import save_figure
from tests.viz.legible import assert_legible


@pytest.fixture(scope="module")
def target():
    return load_target("paper")


def drawn(figure, tmp_path):
    assert_legible(figure)
    return save_figure(figure, tmp_path / "plot.png").stat().st_size > 1000


def test_cells_show_every_edge_point_of_the_worst_cell(target, tmp_path):
    figure = viz.plot_cells(target, UniformRings(5, 4))
    scores, shape = figure.axes[:2]
    assert scores.images[0].get_array().shape == (5, 180)
    points = max(
        (line for line in shape.lines if line.get_linestyle() == "None"), key=lambda line: len(line.get_xdata())
    )
    assert len(points.get_xdata()) == 8  # two ends of four rings
    assert drawn(figure, tmp_path)


def test_sensitivity_is_least_where_the_worst_motion_is(target, tmp_path):
    figure = viz.plot_sensitivity(target, UniformRings())
    assert "least" in figure.axes[0].get_title()
    assert drawn(figure, tmp_path)


def test_comparison_has_a_bar_per_number(target, tmp_path):
    judgements = [judge(target, load_sensor("vlp16"), 8.0), judge(load_target("square"))]
    figure = viz.plot_comparison(judgements)
    assert len(figure.axes[1].patches) == 6
    assert drawn(figure, tmp_path)


def test_search_shows_every_start(tmp_path):
    found = search(Problem(rings=UniformRings(2, 3), steps=(0.2,)), 2, seed=0)
    figure = viz.plot_search(found)
    assert sum(len(line.get_xdata()) for line in figure.axes[0].lines) == 2
    assert drawn(figure, tmp_path)


def test_convexity(tmp_path):
    figure = viz.plot_convexity()
    titles = [axes.get_title() for axes in figure.axes]
    assert "not convex" not in titles[0]
    assert "not convex" in titles[1]
    assert drawn(figure, tmp_path)
