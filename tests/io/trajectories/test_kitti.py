"""KITTI trajectories."""

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io import trajectories as tr
from tests.io.trajectories.poses import poses


def test_kitti_round_trip(tmp_path):
    stamps = np.arange(20) * 0.1
    tr.write_kitti(tmp_path / "a.txt", tr.Trajectory(poses(20), stamps), tmp_path / "times.txt")
    back = tr.read_kitti(tmp_path / "a.txt", tmp_path / "times.txt")
    assert np.abs(back.poses - poses(20)).max() < 1e-13
    assert np.abs(back.stamps - stamps).max() < 1e-9
    assert tr.read_kitti(tmp_path / "a.txt").stamps is None


def test_a_kitti_matrix_that_is_no_rotation_is_refused(tmp_path):
    (tmp_path / "bad.txt").write_text("1 0 0 0 0 1 0 0 0 0 -1 0\n")
    with pytest.raises(InputError, match="not a rotation"):
        tr.read_kitti(tmp_path / "bad.txt")
