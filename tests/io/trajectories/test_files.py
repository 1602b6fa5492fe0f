"""Any text is read, or refused in one line."""

import contextlib

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
