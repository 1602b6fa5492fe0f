import numpy as np
import pytest

from optshape_graph import EstimationError, InputError
from optshape_graph.design.bound import covariance_bound
from optshape_graph.design.family import Family
from optshape_graph.design.limits import Limits
from optshape_graph.design.pose_search import (
    Placements,
    PoseProblem,
    attitudes,
    expected_covariance,
    search_for_poses,
)
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target


@pytest.fixture(scope="module")
def sensor():
    return load_sensor("vlp32c")


@pytest.fixture(scope="module")
def problem(sensor):
    limits = Limits(shortest_edge=0.4, asymmetry=0.15)
    return PoseProblem(Placements((sensor,), (10.0,), 16), load_target("paper"), Family(3), limits)


def test_the_reference_counts_as_one(problem):
    np.testing.assert_allclose(problem.ratios(load_target("paper")), 1.0)
    # Its size does not matter: shapes are compared at the area of the limits.
    np.testing.assert_allclose(problem.ratios(load_target("paper@0.2")), 1.0)


def test_the_expected_covariance_is_below_the_bound_and_finite(sensor):
    poses = attitudes(sensor, 15.0, 24, np.radians(50), np.random.default_rng(0))
    square = load_target("square")
    upright = np.array([[1, 0, 0, 10.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    expected = expected_covariance(square, sensor, np.concatenate([poses, upright[None]]))
    assert np.isfinite(expected).all()
    bounds = covariance_bound(square, sensor, poses)
    finite = np.isfinite(bounds[:, 0, 0])
    # What is known besides only adds information.
    assert np.linalg.eigvalsh(bounds[finite] - expected[:-1][finite]).min() > -1e-12
    # The lower edge of the upright square is known to within a gap of rings, 0.333 deg, the upper to within 1 deg.
    gap = 10.0 * np.radians(0.333)
    assert np.sqrt(expected[-1, 5, 5]) == pytest.approx(gap / np.sqrt(12), rel=0.1)


def test_attitudes_are_spread(sensor):
    poses = attitudes(sensor, 20.0, 400, np.radians(50), np.random.default_rng(1))
    incidence = np.degrees(np.arccos(poses[:, 0, 0]))
    assert incidence.max() < 50.0
    assert np.median(incidence) == pytest.approx(50 / np.sqrt(2), abs=3)
    assert np.ptp(poses[:, 2, 3]) <= 20.0 * np.tan(np.radians(0.334))
    assert (poses[:, :3, 0] @ poses[0, :3, 3] > 0).all()  # towards the sensor


def test_a_search_finds_a_better_shape_within_the_limits_again(problem):
    found = search_for_poses(problem, 1, 0, "mine", steps=25)
    assert found.cost < problem.cost(load_target("paper"))
    assert found.target.area == pytest.approx(1.0)
    assert problem.limits.slacks(found.target.polygon[None]).min() > -1e-3
    assert search_for_poses(problem, 1, 0, "mine", steps=25) == found


def test_the_shipped_shape_beats_the_papers_on_placements_of_another_seed():
    sensors = tuple(load_sensor(name) for name in ("vlp32c", "vlp16", "os1-64"))
    placements = Placements(sensors, (10.0, 20.0), 64, seed=9)
    ratios = PoseProblem(placements, load_target("paper")).ratios(load_target("pose-optimal"))
    e_r, e_t = np.exp(np.log(ratios).mean(axis=0))
    assert (e_r < 0.9).all()
    assert e_t[0] < 0.95


def test_former_names_are_loaded():
    for name in ("optimal", "optimal3", "optimal5"):
        assert load_target(name).name == f"score-{name}"
        np.testing.assert_array_equal(load_target(name).vertices, load_target(f"score-{name}").vertices)
    assert load_target("optimal@0.5").area == pytest.approx(0.5)


def test_limits_that_nothing_meets(problem):
    strict = PoseProblem(problem.placements, problem.reference, Family(3), Limits(shortest_edge=3.0))
    with pytest.raises(EstimationError, match="none of 1 starts found a shape within the limits"):
        search_for_poses(strict, 1, 0, steps=5)
    with pytest.raises(InputError, match="at least 4 placements"):
        Placements((load_sensor("vlp16"),), (10.0,), 2)
