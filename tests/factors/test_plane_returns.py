"""Returns against the plane: what they share, kept for each return or spread over columns, is the same measurement."""

import numpy as np
import pytest

from optshape_graph import load_sensor, load_target
from optshape_graph.factors._rows import triangular
from optshape_graph.factors.measurement import template_rows
from optshape_graph.factors.plane_returns import PlaneReturns, plane_measurement, returns_on_plane
from optshape_graph.factors.static import BRIGHTNESS, RANGE_BIAS, SharedError, spread
from optshape_graph.plane import fit_plane
from optshape_graph.scan import Scan
from optshape_graph.simulation import NoiseModel, simulate_target


def near(sensor: str, distance: float) -> Scan:
    model, T = load_sensor(sensor), np.eye(4)
    T[0, 3] = distance
    target = load_target("paper").scaled_to_area(1.0)
    return simulate_target(target, model, T, noise=NoiseModel.of(model), rng=np.random.default_rng(0))


def with_all_errors(scan: Scan) -> PlaneReturns:
    plane = fit_plane(scan.points, scan.ring)
    returns = returns_on_plane(scan, plane.axes[0], plane.distance, azimuth_noise=1e-4)
    if scan.ring is None:
        return returns.with_bands(scan.points, (4, 16, 64))
    return returns.with_angles(plane.axes[0], scan.ring, scan.sensor).with_brightness(plane.axes[0], 0.01)


def dense_rows(returns: PlaneReturns) -> np.ndarray:
    """The rows of the plane beside a column for each error, constants left out."""
    A, _ = template_rows(returns.points, np.broadcast_to([1.0, 0, 0], returns.points.shape), returns.offset)
    columns = spread(returns.moved, returns.which, len(returns.errors))
    return np.column_stack([columns, A / returns.sigma[:, None]])


@pytest.mark.parametrize(("sensor", "distance"), [("vlp16", 8.0), ("vlp32c", 5.0), ("os1-128", 2.5)])
@pytest.mark.parametrize("rings", [True, False])
def test_entries_are_the_columns(sensor: str, distance: float, rings: bool) -> None:
    scan = near(sensor, distance)
    returns = with_all_errors(scan if rings else Scan(points=scan.points, sensor=scan.sensor))
    found = plane_measurement(returns)
    assert found.shared == returns.errors
    assert found.n_rows == len(returns.points)
    R, expected = found.stack[:, :-1], triangular(dense_rows(returns))
    np.testing.assert_allclose(R.T @ R, expected.T @ expected, rtol=0, atol=1e-12 * float((expected**2).sum()))


@pytest.mark.parametrize("rings", [True, False])
def test_the_order_of_returns_does_not_matter(rings: bool) -> None:
    """Nor that a ring has a single return."""
    scan = near("vlp16", 8.0)
    assert scan.ring is not None
    scan = scan.select(np.flatnonzero((scan.ring != scan.ring[0]) | (np.arange(len(scan)) == 0)))
    returns = with_all_errors(scan if rings else Scan(points=scan.points, sensor=scan.sensor))
    shuffled = returns.select(np.random.default_rng(0).permutation(len(scan)))
    R, expected = plane_measurement(shuffled).stack, plane_measurement(returns).stack
    np.testing.assert_allclose(R.T @ R, expected.T @ expected, rtol=0, atol=1e-12 * float((expected**2).sum()))


def test_a_return_knows_its_rings_errors() -> None:
    scan = near("vlp16", 8.0)
    returns = with_all_errors(scan)
    assert scan.ring is not None
    for ring, moved, which in zip(scan.ring, returns.moved, returns.which, strict=True):
        errors = [returns.errors[k] for k in which]
        assert errors[0] == SharedError(RANGE_BIAS, ring=int(ring))
        assert errors[-1] == SharedError(BRIGHTNESS)
        assert {error.ring for error in errors} <= {int(ring), None}
        assert len(moved) == len(set(errors))
