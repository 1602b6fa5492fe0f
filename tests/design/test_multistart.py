import dataclasses

import numpy as np
import pytest

from optshape_graph import EstimationError, InputError
from optshape_graph.design.family import Family
from optshape_graph.design.judgement import DEGREE, worst_cell
from optshape_graph.design.limits import Limits
from optshape_graph.design.multistart import search, upright
from optshape_graph.design.polygons import areas, strictly_convex
from optshape_graph.design.problem import Problem, orientations, random_parameters, solve
from optshape_graph.design.rings import SensorRings, UniformRings
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target
from optshape_graph.runs.workers import Pool

STEP = np.pi / 18
COARSE = Problem(steps=(STEP,))
"""Orientations 10 degrees apart: a start takes a fraction of a second."""


TINY = Problem(rings=UniformRings(2, 3), limits=Limits(asymmetry=None), steps=(np.pi / 9,))
"""For what does not depend on the shape found."""


def test_a_start_improves_and_stays_within_its_limits():
    initial = random_parameters(COARSE, np.random.default_rng([0, 0]))
    start = solve(COARSE, initial)
    polygon = COARSE.family.polygons(start.parameters)
    assert start.slack >= 0
    assert np.linalg.norm(polygon - np.roll(polygon, 1, axis=1), axis=-1).min() >= 0.4
    before = worst_cell(_target(COARSE, initial), orientations(UniformRings(), STEP)).score
    assert start.score > 1.5 * before


def _target(problem, parameters):
    from optshape_graph import Target

    return Target.from_polygon(problem.family.polygons(parameters)[0])


def test_the_score_of_a_start_is_the_score_of_its_shape():
    start = solve(COARSE, random_parameters(COARSE, np.random.default_rng([0, 1])))
    cell = worst_cell(_target(COARSE, start.parameters), orientations(UniformRings(), STEP))
    assert cell.score == pytest.approx(start.score, rel=1e-9)


def test_search_is_the_same_whatever_the_number_of_workers(tmp_path):
    one = search(TINY, 3, seed=5)
    two = search(TINY, 3, seed=5, pool=Pool(2), folder=tmp_path / "starts")
    assert one.starts == two.starts
    assert one.best.score == max(start.score for start in one.starts if start.slack >= 0)
    other = search(TINY, 1, seed=6)
    assert other.starts[0] != one.starts[0]


def test_a_killed_search_resumes_and_loses_nothing(tmp_path):
    whole = search(TINY, 3, seed=5)

    class KilledError(Exception):
        pass

    def kill(done, total):
        if done == 2:
            raise KilledError

    with pytest.raises(KilledError):
        search(TINY, 3, seed=5, folder=tmp_path, progress=kill)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["start-00000.json", "start-00001.json"]
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    seen = []
    resumed = search(TINY, 3, seed=5, folder=tmp_path, progress=lambda *done: seen.append(done))
    assert resumed.starts == whole.starts
    assert seen == [(2, 3), (3, 3)]
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())


def test_starts_of_another_search_are_refused(tmp_path):
    search(TINY, 1, seed=5, folder=tmp_path)
    with pytest.raises(InputError, match="another problem or with another seed"):
        search(TINY, 1, seed=6, folder=tmp_path)
    with pytest.raises(InputError, match="another problem"):
        search(dataclasses.replace(TINY, family=Family(5)), 1, seed=5, folder=tmp_path)
    (tmp_path / "start-00000.json").write_text("{}")
    with pytest.raises(InputError, match=r"start-00000.json"):
        search(TINY, 1, seed=5, folder=tmp_path)


def test_limits_that_no_shape_meets():
    impossible = dataclasses.replace(TINY, limits=Limits(sheet=(0.1, 0.1)))
    with pytest.raises(EstimationError, match="none of 1 starts"):
        search(impossible, 1, seed=0).target()


def test_nonsense_is_refused():
    with pytest.raises(InputError, match="at least 1 start; found 0"):
        search(TINY, 0, seed=0)


def test_target_has_the_area_asked_for():
    problem = dataclasses.replace(COARSE, limits=Limits(area=0.25, shortest_edge=0.2))
    target = search(problem, 1, seed=0).target("small")
    assert target.area == pytest.approx(0.25)
    assert target.name == "small"
    assert target.edge_lengths.min() >= 0.2


def test_rings_of_a_sensor():
    rings = SensorRings.of(load_sensor("vlp32c"), 8.0, placements=2)
    problem = Problem(rings=rings, steps=(np.pi / 18,))
    assert len(orientations(rings, np.pi / 18)) == 36
    assert solve(problem, random_parameters(problem, np.random.default_rng(1))).score > 0


def test_upright_keeps_the_shape():
    polygon = Family(4).polygons([2.9656, 0.0240, 0.7546, 0.2946, 0.3483])[0]
    standing = upright(polygon)
    assert areas(standing) == pytest.approx(1.0)
    assert strictly_convex(standing)
    assert -standing[:, 1].min() <= standing[:, 1].max()


@pytest.mark.parametrize(("name", "least"), [("optimal", 0.0245), ("optimal3", 0.0245), ("optimal5", 0.0245)])
def test_shipped_shapes_hold_their_score(name, least):
    """Twice the published shape's 0.0122, in whole degrees, and still in tenths of a degree."""
    target = load_target(name)
    assert target.area == pytest.approx(1.0, abs=1e-6)
    assert target.edge_lengths.min() >= 0.4
    for step in (DEGREE, DEGREE / 10):
        assert worst_cell(target, orientations(UniformRings(), step)).score >= least
