"""CSV exports of Vicon Nexus."""

import pytest

from optshape_graph.io.mocap import read_mocap
from tests.io.mocap.exports import same, vicon_csv


@pytest.mark.parametrize("first", [1, 501])
def test_vicon_csv(tmp_path, first):
    (tmp_path / "a.csv").write_text(vicon_csv(first=first))
    same(read_mocap(tmp_path / "a.csv"), 100.0, (first - 1) / 100)


def test_subjects_of_vicon_stay_in_the_names(tmp_path):
    (tmp_path / "a.csv").write_text(vicon_csv().replace("corner", "board:corner"))
    assert read_mocap(tmp_path / "a.csv").markers[0] == "board:corner0"
