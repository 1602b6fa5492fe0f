"""Files that are searched together: each has its own outcome, as one by one, and one that is bad costs no other."""

from pathlib import Path

import numpy as np

from optshape_graph import Scan
from optshape_graph.detection.files import DetectFiles
from optshape_graph.io import load_sensor, load_target, write_scan
from optshape_graph.runs.files import UNREADABLE
from tests.detection.scenes import pose, scan_of

PAPER = load_target("paper@1")


def test_bad_files_among_good_ones(tmp_path: Path) -> None:
    sensor = load_sensor("vlp32c")
    paths = [str(tmp_path / f"{name}.pcd") for name in ("first", "missing", "ringless", "last")]
    scans = [scan_of(sensor, [(PAPER, pose(6, y, 0.1, 20, 10, 15))], seed=k).scan for k, y in enumerate((0, 2))]
    write_scan(paths[0], scans[0])
    write_scan(paths[2], Scan(scans[0].points, None, name="ringless"))
    write_scan(paths[3], scans[1])
    task = DetectFiles((PAPER,))
    together = task(paths)
    assert [one.status for one in together] == ["ok", UNREADABLE, UNREADABLE, "ok"]
    assert "missing.pcd" in together[1].reasons[0]
    assert "no rings" in together[2].reasons[0]
    for path, one in zip(paths, together, strict=True):
        [alone] = task([path])
        assert (alone.status, alone.reasons) == (one.status, one.reasons)
        for found, expected in zip(one.entry["targets"], alone.entry["targets"], strict=True):
            assert found["return_indices"] == expected["return_indices"]
            np.testing.assert_allclose(found["T_lidar_target"], expected["T_lidar_target"], atol=1e-7)
