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
    assert load_camera(f"{path}:cam1").name == "cam1"
    with pytest.raises(InputError, match="it has the cameras cam0, cam1: name one, as"):
        load_camera(path)
    with pytest.raises(InputError, match="no camera 'left'; it has the cameras cam0, cam1"):
        load_camera(path, "left")
    assert load_camera(write(tmp_path, KALIBR[: KALIBR.index("cam1")]), "left").name == "cam0"
    without = KALIBR[: KALIBR.index("cam1")].replace("radtan", "none").replace("[0.1, -0.2, 0.001, 0.002]", "[]")
    assert load_camera(write(tmp_path, without)).D.shape == (0,)


OPENCV = """\
%YAML:1.0
---
calibration_time: "Mon Oct 27 20:27:45 2014"
nframes: 20
image_width: 640
image_height: 480
square_size: 1.
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 510., 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.1, -0.2, 0.001, 0.002, 0.05 ]
avg_reprojection_error: 4.42e-01
"""
OPENCV_XML = """\
<?xml version="1.0"?>
<opencv_storage>
<calibration_time>"Mon Oct 27 20:27:45 2014"</calibration_time>
<image_width>640</image_width>
<image_height>480</image_height>
<camera_matrix type_id="opencv-matrix">
  <rows>3</rows> <cols>3</cols> <dt>d</dt>
  <data>500. 0. 320. 0. 510. 240. 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix">
  <rows>5</rows> <cols>1</cols> <dt>d</dt>
  <data>0.1 -0.2 0.001 0.002 0.05</data></distortion_coefficients>
</opencv_storage>
"""
ROS_INI = """\
# oST version 5.0 parameters


[image]

width
640

height
480

[front]

camera matrix
500.0 0.0 320.0
0.0 510.0 240.0
0.0 0.0 1.0

distortion
0.1 -0.2 0.001 0.002 0.05

rectification
1.0 0.0 0.0
0.0 1.0 0.0
0.0 0.0 1.0

projection
500.0 0.0 320.0 0.0
0.0 510.0 240.0 0.0
0.0 0.0 1.0 0.0
"""
EUROC = """\
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: [500, 510, 320, 240] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [0.1, -0.2, 0.001, 0.002, 0.05]
"""
NUMBERS = """\
%YAML:1.0
image_width: 640
image_height: 480
k1: 0.1
k2: -0.2
p1: 0.001
p2: 0.002
k3: 0.05
fx: 500
fy: 510
cx: 320
cy: 240
"""
CAMODOCAL = """\
%YAML:1.0
---
model_type: PINHOLE
camera_name: camera
image_width: 640
image_height: 480
distortion_parameters:
   k1: 0.1
   k2: -0.2
   p1: 0.001
   p2: 0.002
projection_parameters:
   fx: 500
   fy: 510
   cx: 320
   cy: 240
"""
ORB = """\
%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 500.0
Camera1.fy: 510.0
Camera1.cx: 320.0
Camera1.cy: 240.0
Camera1.k1: 0.1
Camera1.k2: -0.2
Camera1.p1: 0.001
Camera1.p2: 0.002
Camera1.k3: 0.05
Camera.width: 640
Camera.height: 480
Camera.fps: 20
Camera.bf: 40.0
"""


@pytest.mark.parametrize("text", [
    OPENCV, OPENCV.replace("nframes: 20", "nframes: &n 20"), OPENCV_XML, ROS_INI, EUROC, NUMBERS, CAMODOCAL, ORB,
    EUROC.replace("[640, 480]", "{width: 640, height: 480}"),
    ROS_FILE.replace("distortion_model: plumb_bob\n", ""),
    ROS_FILE.replace("plumb_bob", "''"),
    ROS_FILE + "avg_reprojection_error: 0.3\ndate: 2020-01-01\n",
    ROS_MESSAGE.replace("roi:", "fps: 30\nroi:"),
    "%YAML:1.0\n" + KALIBR[: KALIBR.index("cam1")].replace("cam0:", "cam0:\n  T_imu_cam: [[1, 0], [0, 1]]"),
    "camera_matrix: [[500, 0, 320], [0, 510, 240], [0, 0, 1]]\ndist_coeff: [[0.1, -0.2, 0.001, 0.002, 0.05]]\n"
    "image_size: [640, 480]\n",
])  # fmt: skip
def test_forms_of_other_programs(tmp_path: Path, text: str) -> None:
    camera = load_camera(write(tmp_path, text))
    assert (camera.model, camera.width, camera.height) == ("pinhole", 640, 480)
    np.testing.assert_array_equal(camera.K, [[500, 0, 320], [0, 510, 240], [0, 0, 1]])
    expected = [0.1, -0.2, 0.001, 0.002, 0.05]
    np.testing.assert_array_equal(camera.D, expected[: len(camera.D)])
    assert len(camera.D) >= 4


def test_opencv_writes_what_is_read(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    K, D = np.array([[500.25, 0, 320.5], [0, 510, 240], [0, 0, 1]]), np.array([[0.1, -0.2, 1e-3, 2e-3, 0.05, 1, 2, 3]])
    for suffix in (".yaml", ".xml", ".json", ".yml"):
        storage = cv2.FileStorage(str(tmp_path / f"a{suffix}"), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", 640)
        storage.write("image_height", 480)
        storage.write("camera_matrix", K)
        storage.write("distortion_coefficients", D)
        storage.write("note", "made by hand")
        storage.release()
        camera = load_camera(tmp_path / f"a{suffix}")
        np.testing.assert_array_equal(camera.K, K)
        np.testing.assert_array_equal(camera.D, D[0])


@pytest.mark.parametrize(("D", "model", "read"), [
    ("[]", "''", []), ("[0, 0, 0, 0, 0, 0]", "plumb_bob", [0] * 5), ("[0.1]", "plumb_bob", [0.1, 0, 0, 0]),
    ("[1, 2, 3, 4, 5, 6, 7, 8]", "rational_polynomial", [1, 2, 3, 4, 5, 6, 7, 8]),
    ("[1, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0, 0, 0, 0]", "rational_polynomial", [1, 2, 3, 4, 5, 6, 7, 8]),
    ("[1, 2, 3, 4, 0]", "Kannala_Brandt4", [1, 2, 3, 4]), ("[]", "equidistant", [0, 0, 0, 0]),
])  # fmt: skip
def test_numbers_of_coefficients(tmp_path: Path, D: str, model: str, read: list[float]) -> None:
    text = ROS_FILE.replace("plumb_bob", model).replace("[0.1, -0.2, 0.001, 0.002, 0.05]", D)
    np.testing.assert_array_equal(load_camera(write(tmp_path, text)).D, read)


def test_camodocal_fisheye(tmp_path: Path) -> None:
    text = CAMODOCAL.replace("PINHOLE", "KANNALA_BRANDT")
    for old, new in (("k1", "k2"), ("k2: -", "k3: -"), ("p1", "k4"), ("p2", "k5"), ("fx", "mu"), ("fy", "mv"),
                     ("cx", "u0"), ("cy", "v0")):  # fmt: skip
        text = text.replace(old, new)
    camera = load_camera(write(tmp_path, text))
    assert camera.model == "equidistant"
    np.testing.assert_array_equal(camera.D, [0.1, -0.2, 0.001, 0.002])
    with pytest.raises(InputError, match=r"model_type: expected plumb_bob, .*, found 'MEI'"):
        load_camera(write(tmp_path, CAMODOCAL.replace("PINHOLE", "MEI")))


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


ONE = KALIBR[: KALIBR.index("cam1")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("width: 3\n", r":1: expected intrinsics with 'schema: .*', a camera matrix .*; found the keys: width"),
        ("- 1\n", "expected a mapping"),
        (OWN.replace("camera/1", "target/1"), r"schema: expected 'optshape/camera/1', found 'optshape/target/1'"),
        (OWN.replace("pinhole", "omni"), r":3: model: expected one of: pinhole, equidistant, found 'omni'"),
        (OWN.replace("width: 640", "width: 0"), r":4: width: expected an integer of at least 1, found 0"),
        (OWN.replace("width: 640", "width: 640.5"), r"width: expected an integer of at least 1, found 640\.5"),
        (OWN.replace("500", "-500"), r":6: K\[0\]\[0\]: expected a finite number above 0, found -500"),
        (OWN.replace("[500, 0,", "[500, 2,"), r"K\[0\]\[1\]: expected 0, found 2"),
        (OWN.replace("320", "700"), r"the principal point \(700, 240\) is outside the image of 640 x 480"),
        (OWN.replace("[0, 0, 1]]", "[0, 0]]"), r"K\[2\]: expected a list of 3 elements, found 2"),
        (OWN.replace("D: [0.1, ", "D: [0.1, 0.1, "), "6 distortion coefficients, expected 0 or 4 or 5 or 8 finite"),
        (OWN.replace("pinhole", "equidistant"), r":7: D: expected a list of 4 elements, found 5"),
        (OWN + "fps: 3\n", r":8: fps: unknown key 'fps'"),
        (OWN + "T_camera_lidar: 3\n", r":1: a LiDAR-camera calibration, .*; expected the intrinsics"),
        (
            ROS_FILE.replace("plumb_bob", "thin_prism"),
            ":5: distortion_model: expected plumb_bob, .*, found 'thin_prism'",
        ),
        (ROS_FILE.replace("0, 0, 1]}\ndist", "0, 0]}\ndist"), r"camera_matrix: expected .* 3 x 3 numbers, found 8"),
        (ROS_FILE.replace("plumb_bob", "fisheye"), "5 distortion coefficients, expected 4"),
        (ROS_FILE.replace("image_width", "imagewide"), "intrinsics without the image's size; expected image_width"),
        (ROS_MESSAGE.replace("binning_x: 0", "binning_x: 2"), "binning_x: expected 0 or 1: .*, found 2"),
        (
            ROS_MESSAGE.replace("x_offset: 0", "x_offset: 8"),
            r"roi\.x_offset: expected no region of interest, so 'x_offset",
        ),
        (ROS_MESSAGE.replace("[500.0", "[0.0"), "focal lengths 0, 510 px"),
        (ONE.replace("pinhole", "omni"), r"cam0\.camera_model: expected plumb_bob, .*, found 'omni'"),
        (ONE.replace("radtan", "fov"), r"distortion_model: expected plumb_bob, radtan, .*, found 'fov'"),
        (ONE.replace("[640, 480]", "[640]"), "cam0: intrinsics without the image's size"),
        ("%YAML:1.0\n" + KALIBR, r":2: it has the cameras cam0, cam1: name one, as camera\.yaml:cam0"),
        ("<?xml version='1.0'?>\n<other/>", "XML of 'other'; expected an OpenCV file"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><opencv_storage/>", "XML with a document type"),
        ("[image]\nwidth\n640\n", "expected a number under 'height'"),
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
