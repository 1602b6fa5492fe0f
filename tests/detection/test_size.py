"""The size of polygons, against numbers drawn from them."""

import numpy as np
import pytest

from optshape_graph import Target
from optshape_graph.detection.size import Size
from optshape_graph.io import load_target


@pytest.mark.parametrize("name", ["paper", "built", "square", "triangle", "diamond"])
def test_spread_is_that_of_the_area(name: str) -> None:
    """Against 200,000 uniform points: their standard deviations are known to 0.3 %."""
    target = load_target(name)
    reach = target.circumradius
    points = np.random.default_rng(0).uniform(-reach, reach, (600_000, 2))
    inside = points[target.contains(points)]
    expected = np.sqrt(np.linalg.eigvalsh(np.cov(inside.T)))
    np.testing.assert_allclose(Size.of(target).spread, expected, rtol=0.01)
    assert Size.of(target).area == pytest.approx(4 * reach**2 * len(inside) / len(points), rel=0.01)


def test_a_rectangle() -> None:
    size = Size.of(Target.from_polygon([[0, 0], [3, 0], [3, 4], [0, 4]]))
    assert size.area == pytest.approx(12.0)
    assert size.diameter == pytest.approx(5.0)
    assert size.width == pytest.approx(3.0)
    np.testing.assert_allclose(size.spread, np.array([3.0, 4.0]) / np.sqrt(12))


@pytest.mark.parametrize("angle", [0.3, 1.2, 2.9])
def test_no_rotation_changes_it(angle: float) -> None:
    target = load_target("paper")
    c, s = np.cos(angle), np.sin(angle)
    turned = Size.of(Target.from_polygon(target.polygon @ [[c, s], [-s, c]]))
    for field, value in vars(Size.of(target)).items():
        np.testing.assert_allclose(getattr(turned, field), value, rtol=1e-9)
