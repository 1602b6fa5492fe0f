"""Sessions from files: real ones, and made ones with something wrong."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from optshape_graph.calibration.camera import calibrate_camera
from optshape_graph.calibration.camera.calibrate import calibrate
from optshape_graph.calibration.camera.session import read_views
from optshape_graph.errors import InputError
from optshape_graph.io import load_session, load_target, save_target
from optshape_graph.target import Tags, Target
from tests.calibration.camera.support import BOARD, T_CAMERA_LIDAR
from tests.calibration.session_support import SESSION_VIEWS, write_session
from tests.shared import SHARED, needs_shared


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return write_session(tmp_path_factory.mktemp("made"))


@pytest.fixture
def session(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "s")
    return tmp_path / "s"


def test_files_to_extrinsic(session):
    steps = []
    views = read_views(load_session(session / "session.yaml"), True, lambda done, total: steps.append((done, total)))
    assert steps[-1] == (2 * SESSION_VIEWS, 2 * SESSION_VIEWS)
    assert [view.scan_name for view in views] == [f"{k}.pcd" for k in range(SESSION_VIEWS)]
    result = calibrate(views)
    T = result.transform("front", "vlp16", result.corrected)[0]
    assert np.linalg.norm(T[:3, 3] - T_CAMERA_LIDAR[:3, 3]) < 0.03


def test_unreadable_image_is_a_views_problem(session):
    (session / "1.png").write_bytes(b"no image")
    views = read_views(load_session(session / "session.yaml"), True)
    assert "1.png: not an image that OpenCV can read (8 bytes)" in views[1].problem
    result = calibrate(views)
    assert [view.used for view in result.views] == [True, False, True, True]
    assert "not an image" in result.views[1].reason


def test_missing_image_is_named_when_the_session_is_read(session):
    (session / "2.png").unlink()
    with pytest.raises(InputError, match=r"session\.yaml:.*no such file: .*2\.png"):
        load_session(session / "session.yaml")


def test_wrong_lens_model_in_all_images_stops(session):
    text = (session / "camera.yaml").read_text().replace("equidistant", "pinhole")
    (session / "camera.yaml").write_text(text)
    with pytest.raises(InputError, match=r"are the intrinsics \('pinhole'\) those of camera 'front'"):
        read_views(load_session(session / "session.yaml"), True)


def test_scan_without_the_target(session):
    (session / "0.pcd").write_text(
        "VERSION .7\nFIELDS x y z ring\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 3\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ascii\n5 0 0.087 8\n5 0.02 0.087 8\n5 0 0.262 9\n"
    )
    views = read_views(load_session(session / "session.yaml"), True)
    assert views[0].scan is None
    assert "3 returns do not make a target" in views[0].problem


def test_crops_that_are_not_there(session):
    text = (session / "session.yaml").read_text()
    (session / "session.yaml").write_text(text.replace("target_points: 3.pcd, ", ""))
    with pytest.raises(InputError, match=r"3\.pcd: the view has no 'target_points'"):
        read_views(load_session(session / "session.yaml"), True)


def test_session_without_images(session):
    text = (session / "session.yaml").read_text()
    for k in range(SESSION_VIEWS):
        text = text.replace(f", image: {k}.png", "")
    (session / "session.yaml").write_text(text)
    with pytest.raises(InputError, match="no view has an image"):
        read_views(load_session(session / "session.yaml"), True)


def test_tags_in_a_target_file_read_back(tmp_path):
    tags = Tags("APRILTAG_36h11", 0.2, {3: (0.1, 0.2), 7: (-0.1, 0.0)}, 0.25)
    save_target(tmp_path / "t.yaml", Target(BOARD.vertices, "tagged", None, tags))
    read = load_target(str(tmp_path / "t.yaml")).tags
    assert read.centres == tags.centres
    assert read.turn == pytest.approx(tags.turn)
    (tmp_path / "t.yaml").write_text((tmp_path / "t.yaml").read_text().replace("'3'", "'three'"))
    with pytest.raises(InputError, match="expected the number of a tag, found 'three'"):
        load_target(str(tmp_path / "t.yaml"))


@needs_shared
def test_real_session():
    """Leave-one-out over the 20 views, clouds as they come; the peer's LiDAR centres leave 8.4 mm by a rigid fit."""
    result = calibrate_camera(SHARED / "data/camera/session.yaml")
    assert all(view.used for view in result.views)
    means = result.cross_validations[0].means()
    assert means["mean_centre_error_mm"] <= 8.0
    assert means["mean_absolute_plane_offset_mm"] <= 3.0
    assert abs(means["mean_signed_plane_offset_mm"]) <= 2.0
    assert result.trusted
    bias, sigma = result.range_bias("vlp16")
    assert -0.03 < bias < 0.0  # its authors set -30 mm; the centres ask for -20, the planes for less
    assert sigma < 0.01
