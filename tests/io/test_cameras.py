"""Intrinsics in the forms of this package, ROS and Kalibr."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.io import load_camera, save_camera
from tests.shared import SHARED, needs_shared

OWN = """\
schema: optshape/camera/1
name: front
model: pinhole
width: 640
height: 480
K: [[500, 0, 320], [0, 510, 240], [0, 0, 1]]
D: [0.1, -0.2, 0.001, 0.002, 0.05]
"""
ROS_FILE = """\
image_width: 640
image_height: 480
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 510, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0.002, 0.05]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [500, 0, 320, 0, 0, 510, 240, 0, 0, 0, 1, 0]}
"""
ROS_MESSAGE = """\
header: {seq: 1, stamp: {secs: 1, nsecs: 2}, frame_id: cam}
height: 480
width: 640
distortion_model: "plumb_bob"
D: [0.1, -0.2, 0.001, 0.002, 0.05]
K: [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [500.0, 0.0, 320.0, 0.0, 0.0, 510.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: False}
---
"""
ROS2_MESSAGE = ROS_MESSAGE.replace("D:", "d:").replace("K:", "k:").replace("R:", "r:").replace("P:", "p:")
KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [500, 510, 320, 240]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  distortion_coeffs: [0.01, 0.02, 0.03, 0.04]
  distortion_model: equidistant
  intrinsics: [400, 410, 330, 250]
  resolution: [640, 480]
  rostopic: /cam1/image_raw
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "camera.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "name"),
    [(OWN, "front"), (ROS_FILE, "front"), (ROS_MESSAGE, "camera"), (ROS2_MESSAGE, "camera")],
    ids=["own", "ROS file", "ROS 1 message", "ROS 2 message"],
)
def test_forms_of_the_same_camera(tmp_path: Path, text: str, name: str) -> None:
    camera = load_camera(write(tmp_path, text))
    assert (camera.name, camera.model, camera.width, camera.height) == (name, "pinhole", 640, 480)
    np.testing.assert_array_equal(camera.K, [[500, 0, 320], [0, 510, 240], [0, 0, 1]])
    np.testing.assert_array_equal(camera.D, [0.1, -0.2, 0.001, 0.002, 0.05])


def test_kalibr(tmp_path: Path) -> None:
    path = write(tmp_path, KALIBR)
    first, second = load_camera(path, "cam0"), load_camera(path, "cam1")
    assert (first.name, first.model, second.model) == ("cam0", "pinhole", "equidistant")
    np.testing.assert_array_equal(first.D, [0.1, -0.2, 0.001, 0.002])
    np.testing.assert_array_equal(second.K, [[400, 0, 330], [0, 410, 250], [0, 0, 1]])
    with pytest.raises(InputError, match="it has the cameras cam0, cam1; expected one of these names, found None"):
        load_camera(path)
    with pytest.raises(InputError, match="found 'left'"):
        load_camera(path, "left")
    assert load_camera(write(tmp_path, KALIBR[: KALIBR.index("cam1")]), "left").name == "cam0"
    without = KALIBR[: KALIBR.index("cam1")].replace("radtan", "none").replace("[0.1, -0.2, 0.001, 0.002]", "[]")
    assert load_camera(write(tmp_path, without)).D.shape == (0,)


@pytest.mark.parametrize("model", ["equidistant", "fisheye"])
@pytest.mark.parametrize("D", ["[0.1, -0.2, 0.03, 0.04]", "[0.1, -0.2, 0.03, 0.04, 0.0]"])
def test_ros_fisheye(tmp_path: Path, model: str, D: str) -> None:
    text = ROS_FILE.replace("plumb_bob", model).replace("[0.1, -0.2, 0.001, 0.002, 0.05]", D)
    camera = load_camera(write(tmp_path, text))
    assert camera.model == "equidistant"
    np.testing.assert_array_equal(camera.D, [0.1, -0.2, 0.03, 0.04])


@needs_shared
def test_real_camera() -> None:
    camera = load_camera(SHARED / "data" / "camera" / "camera.yaml")
    assert (camera.name, camera.model, camera.width, camera.height) == ("front", "equidistant", 1920, 1208)
    np.testing.assert_array_equal(camera.D, [-0.0540096, -0.0784275, 0.0959641, -0.0515253])


@st.composite
def cameras(draw: st.DrawFn) -> CameraIntrinsics:
    model, lengths = draw(st.sampled_from([("pinhole", (0, 4, 5, 8)), ("equidistant", (4,))]))
    width, height = draw(st.integers(2, 9000)), draw(st.integers(2, 9000))
    fx, fy = draw(st.floats(1, 1e5)), draw(st.floats(1, 1e5))
    cx, cy = draw(st.floats(0.5, width - 0.5)), draw(st.floats(0.5, height - 0.5))
    n = draw(st.sampled_from(lengths))
    D = np.array(draw(st.lists(st.floats(-5, 5), min_size=n, max_size=n)))
    name = draw(st.text(min_size=1, max_size=8))
    return CameraIntrinsics(name, model, width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), D)


@given(cameras())
def test_saved_is_loaded(tmp_path_factory: pytest.TempPathFactory, camera: CameraIntrinsics) -> None:
    path = tmp_path_factory.mktemp("camera") / "a.yaml"
    save_camera(path, camera)
    found = load_camera(path)
    assert (found.name, found.model, found.width, found.height) == (
        camera.name,
        camera.model,
        camera.width,
        camera.height,
    )
    np.testing.assert_array_equal(found.K, camera.K)
    np.testing.assert_array_equal(found.D, camera.D)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "width: 3\n",
            r"expected intrinsics with 'schema: .*', a ROS camera_info .*, or a Kalibr .*; found the keys: width",
        ),
        ("- 1\n", "expected a mapping"),
        (OWN.replace("camera/1", "target/1"), r"schema: expected 'optshape/camera/1', found 'optshape/target/1'"),
        (OWN.replace("pinhole", "omni"), r":3: model: expected one of: pinhole, equidistant, found 'omni'"),
        (OWN.replace("width: 640", "width: 0"), r":4: width: expected an integer of at least 1, found 0"),
        (OWN.replace("width: 640", "width: 640.5"), r"width: expected an integer of at least 1, found 640\.5"),
        (OWN.replace("500", "-500"), "camera 'front': focal lengths -500, 510 px, expected positive numbers"),
        (OWN.replace("[500, 0,", "[500, 2,"), r"expected K as \[\[fx, 0, cx\]"),
        (OWN.replace("320", "700"), r"the principal point \(700, 240\) is outside the image of 640 x 480"),
        (OWN.replace("[0, 0, 1]]", "[0, 0]]"), r"K\[2\]: expected a list of 3 elements, found 2"),
        (
            OWN.replace("D: [0.1, ", "D: [0.1, 0.1, "),
            "6 distortion coefficients, expected 0 or 4 or 5 or 8 finite numbers",
        ),
        (
            OWN.replace("pinhole", "equidistant"),
            "5 distortion coefficients, expected 4 finite numbers for 'equidistant'",
        ),
        (OWN + "fps: 3\n", r":8: fps: unknown key 'fps'"),
        (
            ROS_FILE.replace("plumb_bob", "thin_prism"),
            "distortion_model: expected one of: plumb_bob, rational_polynomial",
        ),
        (
            ROS_FILE.replace("0, 0, 1]}\ndist", "0, 0]}\ndist"),
            r"camera_matrix\.data: expected a list of 9 elements, found 8",
        ),
        (ROS_FILE.replace("plumb_bob", "fisheye"), "5 distortion coefficients, expected 4"),
        (ROS_MESSAGE.replace("binning_x: 0", "binning_x: 2"), "binning_x: expected 0 or 1: .*, found 2"),
        (
            ROS_MESSAGE.replace("x_offset: 0", "x_offset: 8"),
            r"roi\.x_offset: expected no region of interest, so 'x_offset: 0'",
        ),
        (ROS_MESSAGE.replace("[500.0", "[0.0"), "focal lengths 0, 510 px"),
        (
            KALIBR[: KALIBR.index("cam1")].replace("pinhole", "omni"),
            r"cam0\.camera_model: expected one of: pinhole, found 'omni'",
        ),
        (
            KALIBR[: KALIBR.index("cam1")].replace("radtan", "fov"),
            r"distortion_model: expected one of: none, radtan, equidistant",
        ),
        (
            KALIBR[: KALIBR.index("cam1")].replace("[640, 480]", "[640]"),
            "resolution: expected a list of width and height",
        ),
    ],
)
def test_files_that_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=message) as raised:
        load_camera(path)
    assert str(raised.value).startswith(str(path))


def test_an_unknown_model_and_a_bad_matrix() -> None:
    with pytest.raises(InputError, match="camera 'a': model 'omni', expected one of: pinhole, equidistant"):
        CameraIntrinsics("a", "omni", 2, 2, np.eye(3))
    with pytest.raises(InputError, match="expected K as 3 x 3 finite numbers"):
        CameraIntrinsics("a", "pinhole", 2, 2, np.eye(2))
    with pytest.raises(InputError, match="an image of 0 x 2 pixels"):
        CameraIntrinsics("a", "pinhole", 0, 2, np.eye(3))
