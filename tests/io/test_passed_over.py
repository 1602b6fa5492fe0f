"""What is not used of the input is counted, and said in one way."""

from __future__ import annotations

from collections import Counter

import numpy as np

from optshape_graph.io.clouds import make_scan
from optshape_graph.io.clouds.columns import Columns
from optshape_graph.io.markers import read_markers
from optshape_graph.io.passed_over import PassedOver


def test_lines_and_json():
    found = PassedOver({"messages of /points": {"truncated": 2}})
    found.skip("images", "unusable file")
    found.skip("images", "no target found", 0)
    found.unused("scans").update(["ambient", "ambient", "nir"])
    found.unused("others")
    assert found.lines() == [
        "2 messages of /points skipped: truncated",
        "1 images skipped: unusable file",
        "fields of scans that are not used: ambient (2 times), nir (1 times)",
    ]
    assert found.to_dict() == {
        "skipped": {"messages of /points": {"truncated": 2}, "images": {"unusable file": 1}},
        "unused_fields": {"scans": {"ambient": 2, "nir": 1}},
    }


def test_fields_of_a_cloud_that_are_not_used():
    x = np.linspace(1.0, 5.0, 4)
    columns = {"x": x, "y": x, "z": x, "intensity": x, "ambient": x, "tag": x}
    unused: Counter[str] = Counter()
    for _ in range(2):
        make_scan(Columns(columns, left_out=("descriptor",)), unused=unused)
    assert unused == {"ambient": 2, "tag": 2, "descriptor": 2}


def test_rows_of_markers_without_a_name(tmp_path):
    path = tmp_path / "markers.csv"
    path.write_text("frame,marker,x,y,z\n0,a,1,2,3\n0,b,1,2.5,3\n0,,1,2.5,3\n")
    assert read_markers(path).passed_over == {"marker without a label": 1}
