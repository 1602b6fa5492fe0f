"""Camera sessions with one thing wrong are refused or flagged, and it is named; right ones are trusted."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from optshape_graph.calibration.camera import CameraCalibration, calibrate_camera
from optshape_graph.calibration.verdict import NOT_TRUSTED
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import OptshapeError
from optshape_graph.evaluation.camera_session import synthetic_camera_session
from optshape_graph.io import load_sensor, load_session
from optshape_graph.target import Chessboard, Target
from tests.calibration.camera.support import BOARD, T_CAMERA_LIDAR
from tests.calibration.camera.wrong_sessions import WRONG, Wrong, says
from tests.shared import SHARED, needs_shared

CAMERA = CameraIntrinsics(
    "front", "pinhole", 1280, 960, np.array([[800.0, 0, 640], [0, 800.0, 480], [0, 0, 1]]),
    np.array([-0.2, 0.05, 0, 0]),
)  # fmt: skip
WIDE = Target(np.array([[0, 0.5, -0.56], [0, 0.5, 0.56], [0, -0.5, 0.56], [0, -0.5, -0.56]]), "wide")
"""A board of another size, on which the pattern fits either way round."""

BEFORE_ANY_WORK = (
    "squares of 105 mm for 95",
    "a pattern larger than its board",
    "squares counted for corners",
    "corners in the other order",
    "another lens model",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    synthetic_camera_session(folder, BOARD, load_sensor("vlp16"), CAMERA, T_CAMERA_LIDAR, views=10, rng=21)
    return folder


def outcome(folder: Path, allow_outside: bool = False) -> CameraCalibration | str:
    """The session's calibration, or why it is refused."""
    try:
        return calibrate_camera(load_session(folder / "session.yaml", allow_outside=allow_outside))
    except OptshapeError as error:
        return str(error)


def check(wrong: Wrong, result: CameraCalibration | str) -> None:
    if isinstance(result, str):
        assert says(result, wrong), result
        return
    said = [*result.warnings, *(view.reason for view in result.views)]
    assert any(says(text, wrong) for text in said), said
    left_out = sum(not view.used for view in result.views)
    assert result.verdict == NOT_TRUSTED or left_out == 2, said  # two swapped images are left out of the rest


@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: wrong.name)
def test_simulated_session(wrong: Wrong, made: Path, tmp_path: Path) -> None:
    shutil.copytree(made, tmp_path / "s")
    wrong.apply(tmp_path / "s")
    check(wrong, outcome(tmp_path / "s"))


def test_simulated_session_is_right(made: Path) -> None:
    result = outcome(made)
    assert isinstance(result, CameraCalibration)
    assert result.trusted, result.warnings
    assert all(view.used for view in result.views)
    # The warnings that remain are of how the board was turned, which is drawn.
    assert all("turned about one axis" in warning for warning in result.warnings), result.warnings


@needs_shared
@pytest.mark.parametrize("wrong", [w for w in WRONG if w.name in BEFORE_ANY_WORK], ids=lambda wrong: wrong.name)
def test_recorded_session_before_any_work(wrong: Wrong, tmp_path: Path) -> None:
    """Corner counts and lens models are named within 10 s of one core."""
    folder = linked(SHARED / "data/camera", tmp_path / "s")
    wrong.apply(folder)
    start = time.process_time()
    result = outcome(folder, allow_outside=True)
    assert time.process_time() - start < 10.0
    assert isinstance(result, str)
    check(wrong, result)


@needs_shared
@pytest.mark.benchmark
@pytest.mark.parametrize("wrong", [w for w in WRONG if w.name not in BEFORE_ANY_WORK], ids=lambda wrong: wrong.name)
def test_recorded_session(wrong: Wrong, tmp_path: Path) -> None:
    folder = linked(SHARED / "data/camera", tmp_path / "s")
    wrong.apply(folder)
    check(wrong, outcome(folder, allow_outside=True))


def test_corners_in_the_other_order_on_a_board_where_both_fit(tmp_path: Path) -> None:
    board = Target(WIDE.vertices, "wide", Chessboard((7, 5), 0.095))
    path = synthetic_camera_session(
        tmp_path, board, load_sensor("os1-64"), CAMERA, T_CAMERA_LIDAR, views=6, distances=(2.2, 3.2), rng=22
    )
    assert isinstance(outcome(path.parent), CameraCalibration)
    text = (tmp_path / "target.yaml").read_text()
    swapped = text.replace("- 7\n  - 5", "- 5\n  - 7").replace("[7, 5]", "[5, 7]")
    assert swapped != text
    (tmp_path / "target.yaml").write_text(swapped)
    result = outcome(path.parent)
    assert isinstance(result, str)
    assert "in the other order" in result


def linked(source: Path, folder: Path) -> Path:
    """Copy a session's small files, and link to the folders of its recordings."""
    folder.mkdir()
    for path in source.iterdir():
        if path.is_dir():
            (folder / path.name).symlink_to(path)
        else:
            shutil.copy(path, folder / path.name)
    return folder
