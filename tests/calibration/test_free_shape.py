from dataclasses import replace

import numpy as np
import pytest

from optshape_graph.calibration.camera.crops import planar_returns
from optshape_graph.calibration.free_shape import MeasuredShape, measure_shape
from optshape_graph.errors import EstimationError
from optshape_graph.io import load_sensor, load_target, read_scan
from optshape_graph.scan import Scan
from optshape_graph.simulation.noise import NoiseModel
from optshape_graph.simulation.scene import simulate_target
from optshape_graph.target import Target
from tests.calibration.camera.support import BOARD, placement
from tests.shared import SHARED, needs_shared

VLP16 = load_sensor("vlp16")


JOINT_M = 0.012
"""Three standard deviations of a side by eight scans: the edge of a beam, drawn for each scan, moves it by 11 mm."""


def returns(
    target: Target, n: int, seed: int = 0, sensor=VLP16, share: float = 1.0, further: float = 0.0
) -> list[Scan]:
    """Scans of placements; with a share, heights are reported too large by it, as by a sensor whose beams cross.

    Rings look where the table says, and the board does not bloom: what a beam is wide is what sizes scatter by.
    """
    rng = np.random.default_rng(seed)
    true = replace(sensor, elevations=np.arctan(share * np.tan(sensor.elevations)))
    exact = {"blooming": 0.0, "brightness_bias": 0.0, "odd_ends": 0.0, "elevation_error": 0.0, "azimuth_error": 0.0}
    noise = replace(NoiseModel.of(true), **exact)
    scans = []
    for _ in range(n):
        T = placement(rng)
        T[0, 3] += further
        scans.append(simulate_target(target, true, T, noise=noise, rng=rng))
    return [replace(scan, points=scan.points / [1, 1, share], sensor=sensor) for scan in scans]


def sigmas(shape: MeasuredShape) -> np.ndarray:
    return np.sqrt(np.diag(shape.joint.sides_covariance))


@pytest.mark.parametrize("seed", range(3))
def test_a_right_drawing_agrees(seed):
    shape = measure_shape(returns(BOARD, 20, seed), BOARD)
    assert shape.agrees
    assert not shape.beam_crossing
    assert np.abs(shape.joint.sides - BOARD.edge_lengths).max() < JOINT_M
    assert shape.mean_absolute_error < 0.012
    assert len(shape.scans) == 20


def test_a_wrong_drawing_is_found_and_put_right():
    """The board is 4 cm longer than its file says, and 2 cm narrower."""
    wrong = Target.from_polygon(BOARD.polygon * [0.97, 1.05], "wrong")
    shape = measure_shape(returns(BOARD, 8), wrong)
    assert not shape.agrees
    assert measure_shape(returns(BOARD, 8), BOARD).agrees
    assert np.abs(shape.joint.sides - BOARD.edge_lengths).max() < JOINT_M


def test_the_drawing_does_not_pull():
    a = measure_shape(returns(BOARD, 4), BOARD).joint.sides
    b = measure_shape(returns(BOARD, 4), Target.from_polygon(BOARD.polygon * 1.02, "larger")).joint.sides
    np.testing.assert_allclose(a, b, atol=1.5e-3)


def test_any_polygon():
    """Not a rectangle, and another sensor, 5 m away, whose beam is 24 mm wide."""
    true = load_target("paper@1")
    drawn = Target.from_polygon(true.polygon * [1.04, 0.96], "drawn")
    shape = measure_shape(returns(true, 12, sensor=load_sensor("vlp32c"), further=3.0), drawn)
    off = shape.joint.sides - true.edge_lengths
    assert np.abs(off).max() < 0.02
    assert off @ np.linalg.solve(shape.joint.sides_covariance, off) < 18.5  # chi-square of 4, 99.9 %


def test_sizes_scatter_as_their_covariance_says():
    """Sides of single scans about the truth, in 40 scans: within a third of one standard deviation squared a degree."""
    squared = [
        (off @ np.linalg.solve(scan.sides_covariance, off)) / 4
        for scan in measure_shape(returns(BOARD, 40, seed=5), BOARD).scans
        for off in [scan.sides - BOARD.edge_lengths]
    ]
    assert 0.3 < np.mean(squared) < 1.33


def test_beams_that_cross_beside_the_axis():
    """The likelihoods find that heights are too large, and the sides are right again."""
    scans = returns(BOARD, 10, share=1 - VLP16.beam_crossing / 2.2)
    shape = measure_shape(scans, BOARD)
    assert shape.beam_crossing
    plain = measure_shape([replace(scan, sensor=replace(VLP16, beam_crossing=0.0)) for scan in scans], BOARD)
    assert not plain.beam_crossing
    assert shape.mean_absolute_error < plain.mean_absolute_error


def test_joint_is_surer_than_one_but_not_of_the_beam():
    shape = measure_shape(returns(BOARD, 8), BOARD)
    one = np.sqrt(np.diag(shape.scans[0].sides_covariance))
    assert (sigmas(shape) < one).all()
    assert (sigmas(shape) > 0.008).all()  # a beam 18 mm wide, both ends of a side


def test_nothing_to_measure():
    with pytest.raises(EstimationError, match="no scan to measure target 'board' in"):
        measure_shape([], BOARD)


@needs_shared
def test_the_recorded_board():
    """Width and height of a board of 610 x 850 mm by single scans, on average within 6 mm; the peer's: 9 mm."""
    folder = SHARED / "data/camera"
    board = load_target(folder / "board.yaml")
    crops = [planar_returns(read_scan(folder / f"scans/pose{k:02d}_target.pcd", VLP16)) for k in range(1, 21)]
    shape = measure_shape(crops, board)
    assert shape.mean_absolute_error < 0.006
    assert shape.agrees
