"""Maps as files, and two maps made one."""

import json

import numpy as np
import pytest

from optshape_graph import Target
from optshape_graph.errors import InputError
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.mapping import Landmark, Map, load_map, merge_maps, save_map
from optshape_graph.se3 import inverse
from tests.factors.support import TARGET, log, random_pose, retract
from tests.mapping.support import covariance

SQUARE = Target.from_polygon([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)], "square")


def a_map(names, frame=None, seed=0, sigma=0.01, common=0.05, template=TARGET, session="one"):
    """Return landmarks at fixed places, seen from a frame that is itself uncertain, errors drawn accordingly."""
    rng = np.random.default_rng(seed)
    T_frame = np.eye(4) if frame is None else frame
    truth = {name: random_pose(np.random.default_rng(ord(name)), 1.0, 8.0) for name in "abcdef"}
    n = 6 * len(names)
    root = np.hstack([sigma * np.eye(n), common * np.tile(np.eye(6), (len(names), 1))])
    xi = root @ rng.normal(size=n + 6)
    landmarks = []
    joint = root @ root.T
    for k, name in enumerate(names):
        T = retract(T_frame @ truth[name], xi[6 * k : 6 * k + 6])
        landmarks.append(Landmark(name, template, T, joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6], 3))
    poses = np.array([T_frame, T_frame @ truth["a"]])
    return Map(tuple(landmarks), joint, {session: Trajectory(poses, np.array([1.0, 2.5]), session)})


def test_a_map_survives_its_file(tmp_path):
    made = a_map("abc")
    save_map(tmp_path / "map.json", made)
    read = load_map(tmp_path / "map.json")
    np.testing.assert_array_equal(read.covariance, made.covariance)
    for one, other in zip(read.landmarks, made.landmarks, strict=True):
        np.testing.assert_array_equal(one.T_world_target, other.T_world_target)
        np.testing.assert_array_equal(one.target.vertices, other.target.vertices)
        assert (one.id, one.observations) == (other.id, other.observations)
    np.testing.assert_array_equal(read.trajectories["one"].poses, made.trajectories["one"].poses)
    document = json.loads((tmp_path / "map.json").read_text())
    assert document["schema"] == "optshape/map/1"
    assert set(document["landmarks"][0]) == {
        "id", "target", "T_world_target", "covariance", "vertices", "observations",
    }  # fmt: skip
    assert document["session"] == "one"
    assert set(document["trajectory"][0]) == {"stamp", "T_world_lidar"}
    both = merge_maps(made, a_map("bcd", session="two"))
    save_map(tmp_path / "both.json", both)
    assert set(load_map(tmp_path / "both.json").trajectories) == {"one", "two"}
    document = json.loads((tmp_path / "both.json").read_text())
    assert set(document["trajectory"][0]) == {"session", "stamp", "T_world_lidar"}


def test_a_survey_is_a_map_without_joint_covariance(tmp_path):
    survey = Map((Landmark("a", TARGET, np.eye(4), covariance([0.01] * 6)),))
    save_map(tmp_path / "survey.json", survey)
    assert load_map(tmp_path / "survey.json").joint_covariance is None
    np.testing.assert_allclose(survey.covariance, covariance([0.01] * 6))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["landmarks"][0].pop("covariance"), "covariance"),
        (lambda d: d["landmarks"][0].update(T_world_target=np.ones((4, 4)).tolist()), "not a rigid transform"),
        (lambda d: d["landmarks"].append(d["landmarks"][0]), "expected a list of 18 elements"),
        (lambda d: d.update(extra=1), "unknown key 'extra'"),
        (lambda d: d["targets"].pop("a"), "no template for landmark 'a'"),
        (lambda d: d["landmarks"][0].update(covariance=(-np.eye(6)).tolist()), "not symmetric and positive"),
    ],
)
def test_wrong_files_say_what_is_wrong(tmp_path, change, message):
    save_map(tmp_path / "map.json", a_map("ab"))
    document = json.loads((tmp_path / "map.json").read_text())
    change(document)
    (tmp_path / "map.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=message) as error:
        load_map(tmp_path / "map.json")
    assert "map.json" in str(error.value)


@pytest.mark.parametrize("template", [TARGET, SQUARE])
def test_merged_maps_know_more_than_either(template):
    frame = random_pose(np.random.default_rng(1), 1.0, 3.0)
    a = a_map("abcd", template=template)
    b = a_map("cdef", frame, seed=1, template=template, session="two")
    merged = merge_maps(a, b)
    assert [m.id for m in merged.landmarks] == list("abcdef")
    assert set(merged.trajectories) == {"one", "two"}
    assert merged["c"].observations == 6
    # The frame of `a` stays: what both maps know, relative to another landmark, is known better than in either.
    assert _relative(merged, "c", "d") < _relative(a, "c", "d")
    truth = {name: random_pose(np.random.default_rng(ord(name)), 1.0, 8.0) for name in "abcdef"}
    xi = np.concatenate([log(inverse(m.T_world_target) @ truth[m.id]) for m in merged.landmarks])
    assert xi @ np.linalg.solve(merged.covariance, xi) / len(xi) < 2.0  # chi-square with 36 degrees: 99.9 % below 1.9


def _relative(result, a, b):
    names = [m.id for m in result.landmarks]
    i, j = (slice(6 * names.index(n), 6 * names.index(n) + 6) for n in (a, b))
    C = result.covariance
    return np.trace(C[i, i] + C[j, j] - C[i, j] - C[j, i])


def test_maps_that_do_not_go_together():
    with pytest.raises(InputError, match="no landmark in common"):
        merge_maps(a_map("ab"), a_map("cd", session="two"))
    with pytest.raises(InputError, match="both maps have a session 'one'"):
        merge_maps(a_map("ab"), a_map("bc"))
    with pytest.raises(InputError, match="two landmarks are called 'a'"):
        a_map("aa")
    triangle = Target.from_polygon([(0, 0), (1, 0), (0, 1)], "triangle")
    with pytest.raises(InputError, match="landmark 'b' is a"):
        merge_maps(a_map("ab"), a_map("bc", template=triangle, session="two"))
