import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from optshape_graph import InputError
from optshape_graph.io import trajectories as tr


def poses(n: int, seed: int = 0) -> np.ndarray:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.random(n, rng=seed).as_matrix()
    T[:, :3, 3] = np.random.default_rng(seed).normal(0, 100, (n, 3))
    return T


def test_tum_round_trip(tmp_path):
    stamps = 1.7e9 + np.cumsum(np.random.default_rng(1).uniform(0.01, 0.2, 50))
    tr.write_tum(tmp_path / "a.tum", tr.Trajectory(poses(50), stamps))
    back = tr.read_tum(tmp_path / "a.tum")
    assert np.abs(back.stamps - stamps).max() < 2.5e-7  # float64 at 1.7e9 s
    assert np.abs(back.poses - poses(50)).max() < 1e-13  # quaternion to matrix and back


def test_kitti_round_trip(tmp_path):
    stamps = np.arange(20) * 0.1
    tr.write_kitti(tmp_path / "a.txt", tr.Trajectory(poses(20), stamps), tmp_path / "times.txt")
    back = tr.read_kitti(tmp_path / "a.txt", tmp_path / "times.txt")
    assert np.abs(back.poses - poses(20)).max() < 1e-13
    assert np.abs(back.stamps - stamps).max() < 1e-9
    assert tr.read_kitti(tmp_path / "a.txt").stamps is None


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
    ("line", "complaint"),
    [
        ("1 0 0 0 0 0 0", "expected 8 numbers"),
        ("1 0 0 0 0 0 0 x", "could not convert"),
        ("1 0 0 nan 0 0 0 1", "not a finite"),
        ("1 0 0 0 0 0 0 0", "norm 0"),
        ("1 0 0 0 0 0 0 2", "norm 2"),
        ("0.5 0 0 0 0 0 0 1", "does not exceed"),
    ],
)
def test_bad_tum_lines_are_named(tmp_path, line, complaint):
    file = tmp_path / "bad.tum"
    file.write_text(f"# stamp\n0.9 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match=complaint) as error:
        tr.read_tum(file)
    assert "bad.tum" in str(error.value)


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


def test_a_kitti_matrix_that_is_no_rotation_is_refused(tmp_path):
    (tmp_path / "bad.txt").write_text("1 0 0 0 0 1 0 0 0 0 -1 0\n")
    with pytest.raises(InputError, match="not a rotation"):
        tr.read_kitti(tmp_path / "bad.txt")


@given(st.text(alphabet="0123456789 .-e\nnaif#VERTXQU:ADGS_E3", max_size=200))
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    file = tmp_path_factory.mktemp("fuzz") / "a.txt"
    file.write_text(text)
    for read in (tr.read_tum, tr.read_kitti, tr.read_g2o):
        with contextlib.suppress(InputError):
            read(file)
