"""How rings end on a panel: free, before a bend, beside an occluder."""

import numpy as np

from optshape_graph import Target
from optshape_graph.detection.borders import Borders, borders
from optshape_graph.detection.segments import sweep
from optshape_graph.io import load_sensor, load_target
from optshape_graph.simulation import Box, Patch, Surface
from tests.detection.scenes import pose, scan_of

VLP32C, SQUARE = load_sensor("vlp32c"), load_target("square@1")


def ends_of_panel(*things: Surface) -> Borders:
    simulated = scan_of(VLP32C, [(SQUARE, pose(6, 0, 0))], *things)
    ordered = sweep(simulated.scan)
    return borders(ordered, np.flatnonzero(simulated.surface[ordered.index] == 0))


def test_free() -> None:
    ends = ends_of_panel()
    assert ends.open.mean() > 0.95
    assert not ends.hidden.any()


def test_sides_that_bend_away() -> None:
    side = Target.from_polygon([[0, 0], [0.2, 0], [0.2, 1], [0, 1]], "side")
    back, out = 0.1 * np.sin(np.radians(30)), 0.5 + 0.1 * np.cos(np.radians(30))
    bay = [Patch(side, pose(6 + back, sign * out, 0, 0, 0, -30 * sign)) for sign in (-1, 1)]
    ends = ends_of_panel(*bay)
    assert ends.open.mean() < 0.1
    assert not ends.hidden.any()


def test_a_post_before_one_side() -> None:
    ends = ends_of_panel(Box(np.array([0.1, 0.3, 3.0]), pose(5, 0.45, 0)))
    left, right = np.split(ends.hidden, 2)
    assert {left.mean() > 0.95, right.mean() > 0.95} == {True, False}
    assert not (ends.open & ends.hidden).any()
