"""What several rays within a beam's width of an edge do to a ring's last return."""

import numpy as np
import pytest

from optshape_graph.beam import FINEST_STEP, outermost_return


@pytest.mark.parametrize("step", [0.25, 0.5, 0.8, 2.0])
def test_outermost_of_rays_that_happen_to_return(step: float) -> None:
    """Against drawn rays, each of which returns if its own threshold, uniform over the beam, lets it."""
    rng = np.random.default_rng(0)
    place = step * (rng.uniform(size=(40_000, 1)) + np.arange(-np.ceil(1.5 / step) - 1, np.ceil(0.5 / step) + 1))
    last = np.where(rng.uniform(-0.5, 0.5, place.shape) > place, place, -np.inf).max(axis=1)
    shift, share = outermost_return(np.array([step]))
    assert last.mean() == pytest.approx(shift[0] - step / 2, abs=0.01)
    assert last.var() == pytest.approx(share[0] ** 2 / 12 + step**2 / 12, rel=0.04)


def test_one_ray_is_as_before_and_a_ring_along_an_edge_no_finer_than_the_finest() -> None:
    shift, share = outermost_return(np.array([1.0, 5.0, FINEST_STEP, 1e-6]))
    np.testing.assert_allclose(share[:2], 1.0, atol=0.01)
    np.testing.assert_allclose(shift[:2], 0.0, atol=0.01)
    assert shift[2] == shift[3]
    assert share[2] == share[3]
