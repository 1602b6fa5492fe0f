import numpy as np
import pytest

from optshape_graph.calibration.camera.crops import planar_returns
from optshape_graph.errors import EstimationError
from optshape_graph.scan import Scan


def test_returns_off_the_plane_go():
    rng = np.random.default_rng(0)
    plane = np.column_stack([np.full(200, 2.0) + rng.normal(0, 0.01, 200), rng.uniform(-0.5, 0.5, (200, 2))])
    others = np.column_stack([rng.uniform(2.1, 2.3, 30), rng.uniform(-0.5, 0.5, (30, 2))])
    kept = planar_returns(Scan(np.vstack([plane, others]), ring=np.arange(230)))
    assert len(kept) >= 198
    assert set(kept.ring) <= set(range(200))


@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.random.default_rng(1).uniform(-1, 1, (200, 3))])
def test_no_plane(points):
    with pytest.raises(EstimationError):
        planar_returns(Scan(points, name="crop"))
