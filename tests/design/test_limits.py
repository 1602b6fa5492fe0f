import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.design.family import Family
from optshape_graph.design.limits import Limits, diameters, widths

SQUARE = Family(4).nominal[None]


def smallest(limits, polygons=SQUARE):
    return limits.slacks(polygons).min()


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        (Limits(shortest_edge=0.5, asymmetry=None), 1.0),
        (Limits(area=4.0, shortest_edge=0.5, asymmetry=None), 3.0),
        (Limits(shortest_edge=None, asymmetry=None, smallest_angle=np.pi / 4), 1.0),
        (Limits(shortest_edge=None, asymmetry=None, aspect=2 * np.sqrt(2)), 1.0),
        (Limits(shortest_edge=None, asymmetry=0.1), -1.0),
        (Limits(shortest_edge=None, asymmetry=None, sheet=(2.0, 4.0)), 0.5),
        (Limits(shortest_edge=None, asymmetry=None, sheet=(0.5, 4.0)), -1.0),
    ],
)
def test_slacks_of_the_unit_square(limits, expected):
    assert smallest(limits) == pytest.approx(expected, abs=1e-9)


def test_a_shape_is_turned_to_fit_its_sheet():
    turned = SQUARE @ np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    # Orientations a degree apart: half a degree off the best is 0.9 % wider.
    assert smallest(Limits(shortest_edge=None, asymmetry=None, sheet=(1.01, 1.01)), turned) >= 0


def test_no_limits_no_slacks():
    assert Limits(shortest_edge=None, asymmetry=None).slacks(SQUARE).shape == (1, 0)


def test_width_and_diameter():
    assert diameters(SQUARE)[0] == pytest.approx(np.sqrt(2))
    np.testing.assert_allclose(widths(SQUARE)[0], 1.0)


def test_nonsense_is_refused():
    with pytest.raises(InputError, match="shortest_edge: expected a positive number; found -1"):
        Limits(shortest_edge=-1.0)
    with pytest.raises(InputError, match="sheet"):
        Limits(sheet=(0.0, 1.0))
