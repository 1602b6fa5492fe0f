from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import InputError, Target
from optshape_graph.design.measured import as_measured
from optshape_graph.io.targets import load_target
from optshape_graph.target import Chessboard, Tags


def lengths(target, pairs):
    return {(i, j): float(np.linalg.norm(target.polygon[i] - target.polygon[j])) for i, j in pairs}


def test_sides_and_diagonals_give_the_outline_back():
    drawn = load_target("paper")
    rng = np.random.default_rng(0)
    built = Target.from_polygon(drawn.polygon + rng.normal(0, 0.003, (4, 2)))
    found = as_measured(drawn, lengths(built, [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)]))
    again = lengths(found, [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)])
    for pair, length in lengths(built, again).items():
        assert again[pair] == pytest.approx(length, abs=1e-4)  # the drawing pulls by the ratio of variances
    assert found.name == "paper"


def test_a_print_that_came_out_smaller_takes_its_pattern_along():
    drawn = replace(
        load_target("paper"), chessboard=Chessboard((4, 6), 0.1, (0.03, 0.0)), tags=Tags("4X4_50", 0.2, {1: (0.1, 0.2)})
    )
    scaled = {pair: 0.99 * length for pair, length in lengths(drawn, [(0, 1), (1, 2), (2, 3), (3, 0)]).items()}
    found = as_measured(drawn, scaled, 0.99)
    np.testing.assert_allclose(found.polygon, 0.99 * drawn.polygon, atol=1.5e-3)
    assert found.chessboard.square == pytest.approx(0.099)
    assert found.chessboard.offset[0] == pytest.approx(0.0297, abs=1e-3)
    assert found.tags.size == pytest.approx(0.198)


def test_nothing_measured_changes_nothing():
    drawn = load_target("built")
    np.testing.assert_allclose(as_measured(drawn, {}).vertices, drawn.vertices, atol=1e-12)


@pytest.mark.parametrize(
    ("pair", "length", "message"),
    [
        ((0, 4), 1.0, "two of the vertices 0 to 3"),
        ((0, 1), -1.0, "positive number; found -1"),
        ((0, 1), 1200.0, "length 0-1: 1200000.0 mm fits no outline near the drawn one, where it is 942.6 mm"),
    ],
)
def test_mistakes_are_named(pair, length, message):
    with pytest.raises(InputError, match=message):
        as_measured(load_target("paper"), {pair: length, (1, 2): 1.12127})


def test_a_print_scale_that_is_a_length_is_refused():
    with pytest.raises(InputError, match="within 10 % of 1"):
        as_measured(load_target("paper"), {}, 99.2)
