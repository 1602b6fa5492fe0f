"""Pose graphs."""

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io import trajectories as tr
from tests.io.trajectories.poses import poses


def graph(seed: int) -> tr.PoseGraph:
    rng = np.random.default_rng(seed)
    T = poses(6, seed)
    edges = []
    for i in range(5):
        A = rng.normal(size=(6, 6))
        edges.append(tr.PoseGraphEdge(i, i + 1, np.linalg.inv(T[i]) @ T[i + 1], A @ A.T))
    return tr.PoseGraph(dict(enumerate(T)), tuple(edges), frozenset({0}))


def test_g2o_round_trip(tmp_path):
    there = graph(3)
    tr.write_g2o(tmp_path / "a.g2o", there)
    back = tr.read_g2o(tmp_path / "a.g2o")
    assert back.fixed == {0}
    assert list(back.vertices) == list(range(6))
    for i in range(6):
        assert np.abs(back.vertices[i] - there.vertices[i]).max() < 1e-12
    for ours, theirs in zip(back.edges, there.edges, strict=True):
        assert (ours.i, ours.j) == (theirs.i, theirs.j)
        assert np.abs(ours.T_i_j - theirs.T_i_j).max() < 1e-12
        assert np.abs(ours.information - theirs.information).max() < 1e-12


def test_gtsam_reads_the_same_graph_and_the_same_information(tmp_path):
    import gtsam

    there = graph(4)
    tr.write_g2o(tmp_path / "a.g2o", there)
    factors, values = gtsam.readG2o(str(tmp_path / "a.g2o"), True)
    for i, T in there.vertices.items():
        assert np.abs(values.atPose3(i).matrix() - T).max() < 1e-12
    for k, edge in enumerate(there.edges):
        noise = factors.at(k).noiseModel()
        assert np.abs(noise.information() - edge.information).max() < 1e-9 * np.abs(edge.information).max()
        assert np.abs(factors.at(k).measured().matrix() - edge.T_i_j).max() < 1e-12


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("VERTEX_SE2 0 0 0 0", "element 'VERTEX_SE2'"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0", "found 7 words"),
        ("VERTEX_SE3:QUAT a 0 0 0 0 0 0 1", "integer"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n" * 2, "twice"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nEDGE_SE3:QUAT 0 7 0 0 0 0 0 0 1 " + "0 " * 21, "vertex 7"),
        ("EDGE_SE3:QUAT 0 0 0 0 0 0 0 0 1 -1 " + "0 " * 20, "negative eigenvalue"),
    ],
)
def test_bad_g2o_is_named(tmp_path, text, complaint):
    (tmp_path / "bad.g2o").write_text(text)
    with pytest.raises(InputError, match=complaint):
        tr.read_g2o(tmp_path / "bad.g2o")
