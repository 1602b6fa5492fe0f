import json

import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from optshape_graph.cli.main import cli
from tests.calibration.session_support import write_session


@pytest.fixture
def session(tmp_path):
    return write_session(tmp_path)


def run(*arguments):
    return CliRunner().invoke(cli, ["calibrate", "camera", *map(str, arguments)], standalone_mode=False)


def test_writes_everything(session):
    (session / "3.png").write_bytes(b"broken")
    result = run(
        session / "session.yaml", "--use-target-points", "--json", session / "out.json",
        "--plot", session / "overlays", "--camchain", session / "camchain.yaml",
    )  # fmt: skip
    assert result.exception is None, result.exception
    assert result.return_value == 3  # one view was not used
    document = json.loads((session / "out.json").read_text())
    assert document["schema"] == "optshape/camera-calibration/1"
    assert [view["used"] for view in document["views"]] == [True, True, True, False]
    assert document["skipped"] == {"images": {"unusable file": 1}}
    assert "1 images skipped: unusable file" in result.output
    assert "cam0" in yaml.safe_load((session / "camchain.yaml").read_text())
    overlays = sorted((session / "overlays").iterdir())
    assert [path.name for path in overlays[3:]] == ["errors.png"]
    assert str(overlays[-1]) in result.output
    assert cv2.imread(str(overlays[0])).shape == (1208, 1920, 3)
    for text in ("T_front_vlp16", "T_vlp16_front", "rosrun tf2_ros", "ros2 run tf2_ros", "URDF: <origin", "range bias"):
        assert text in result.output
    assert "not used: 3.pcd / 3.png: " in result.output + result.stderr


def test_overlay_shows_the_outline_where_the_camera_sees_it(session):
    run(session / "session.yaml", "--use-target-points", "--overlays", session / "overlays")
    picture = cv2.imread(str(sorted((session / "overlays").iterdir())[0])).astype(int)
    original = cv2.imread(str(session / "0.png")).astype(int)
    changed = np.abs(picture - original).max(axis=2) > 60
    assert 500 < changed[80:].sum() < 60_000  # an outline and some hundred returns


@pytest.mark.parametrize("arguments", [["no.yaml"], []])
def test_bad_usage(arguments):
    assert run(*arguments).exception is not None
