"""`optshape calibrate mocap` on the bundled session and on the recordings."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import optshape_graph
from optshape_graph.cli.main import cli
from tests.shared import SHARED, needs_shared

DEMO = Path(optshape_graph.__file__).parent / "data" / "demo"


def calibrate(session: Path, output: Path, *options: str) -> tuple[int, dict, str]:
    result = CliRunner().invoke(
        cli, ["calibrate", "mocap", str(session), "--json", str(output), *options], standalone_mode=False
    )
    if result.exception:
        raise result.exception
    return result.return_value, json.loads(output.read_text()), result.output


def test_demo_session(tmp_path: Path) -> None:
    code, document, text = calibrate(DEMO / "session.yaml", tmp_path / "out.json")
    truth = json.loads((DEMO / "truth.json").read_text())
    assert code == 0
    assert document["schema"] == "optshape/mocap/1"
    assert document["protocol"] == "leave-one-out"
    assert "leave-one-out" in text.lower()
    T, expected = np.array(document["T_lidar_mocap"]), np.array(truth["T_lidar_mocap"])
    # Over the targets, a few metres away, the frames agree to a centimetre or two: the layout's prior is 3 cm.
    assert np.abs(T[:3, :3] - expected[:3, :3]).max() < 0.02
    assert np.array(document["covariance"]).shape == (6, 6)
    assert np.array(document["marker_layout"]).shape == (4, 3)
    for part in (document, document["in_sample"]):
        assert len(part["scans"]) == 8
        for key in ("rmse_m", "e_t_m", "e_r_deg"):
            assert part["mean"][key] == pytest.approx(np.mean([scan[key] for scan in part["scans"]]))
    assert document["mean"]["rmse_m"] < 0.02
    # In-sample flatters.
    assert document["in_sample"]["mean"]["rmse_m"] < document["mean"]["rmse_m"]


def test_scale_is_one_unless_asked_for(tmp_path: Path) -> None:
    _, off, _ = calibrate(DEMO / "session.yaml", tmp_path / "a.json")
    _, on, _ = calibrate(DEMO / "session.yaml", tmp_path / "b.json", "--estimate-scale")
    assert off["scale"] == 1.0
    assert on["scale"] != 1.0
    assert abs(on["scale"] - 1.0) < 4 * on["scale_sigma"]


@needs_shared
def test_recordings(tmp_path: Path) -> None:
    """Means over sessions 1 and 3 of the published estimates, same protocol: 0.029 m, 0.012 m, 3.1 deg."""
    scans = []
    for k in (1, 3):
        code, document, _ = calibrate(SHARED / f"data/mocap/session{k}/session.yaml", tmp_path / f"{k}.json")
        assert code == 0
        scans += document["scans"]
    assert np.mean([scan["rmse_m"] for scan in scans]) <= 0.019
    assert np.mean([scan["e_t_m"] for scan in scans]) <= 0.012
    assert np.mean([scan["e_r_deg"] for scan in scans]) <= 2.0
