"""Any text is read, or refused in one line."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.io import trajectories as tr


@given(st.text(alphabet="0123456789 .-e\nnaif#VERTXQU:ADGS_E3", max_size=200))
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    file = tmp_path_factory.mktemp("fuzz") / "a.txt"
    file.write_text(text)
    for read in (tr.read_tum, tr.read_kitti, tr.read_g2o):
        with contextlib.suppress(InputError):
            read(file)


def test_a_pose_graph_is_no_trajectory(tmp_path):
    (tmp_path / "a.g2o").write_text("# made\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"a pose graph \(g2o\), whose poses have no stamps; expected a trajectory"):
        tr.read_trajectory(tmp_path / "a.g2o")
