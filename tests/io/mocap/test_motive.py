"""CSV exports of OptiTrack Motive."""

import pytest

from optshape_graph.io.mocap import read_mocap
from tests.io.mocap.exports import motive_csv, same


@pytest.mark.parametrize(("unit", "scale"), [("Meters", 1.0), ("Millimeters", 1e3), ("Centimeters", 1e2)])
@pytest.mark.parametrize("both", [False, True])
def test_motive_csv(tmp_path, unit, scale, both):
    (tmp_path / "a.csv").write_text(motive_csv(unit, scale, both), encoding="utf-8-sig")
    same(read_mocap(tmp_path / "a.csv"), 120.0)
