"""Camera intrinsics: `schema: optshape/camera/1`, ROS `camera_info`, and Kalibr's camchain."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.camera import DISTORTION_LENGTHS, CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.documents import Node, check_schema, read_json, read_yaml, write_yaml

ROS_MODELS = {
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}
"""CameraInfo's distortion_model to this package's."""

_KALIBR_MODELS = {"none": "pinhole", "radtan": "pinhole", "equidistant": "equidistant"}


def load_camera(path: str | Path, name: str | None = None) -> CameraIntrinsics:
    """Read intrinsics in one of three forms, told apart by their keys.

    - This package's own, with `schema: optshape/camera/1`.
    - ROS: the file that `camera_calibration` writes, or a CameraInfo message of ROS 1 or 2 as `topic echo` prints it.
    - Kalibr: a camchain, of one camera or several.

    Args:
        path: a YAML or JSON file.
        name: which camera of a camchain with several; not needed, and not looked at, otherwise.

    Raises:
        InputError: not readable, none of these forms, a model this package does not have, or values that no camera has
            (see `CameraIntrinsics`).
    """
    path = Path(path)
    root = read_json(path) if path.suffix.lower() == ".json" else read_yaml(path)
    keys = root.entries()
    try:
        if "schema" in keys:
            return _read_own(root, path)
        if "camera_matrix" in keys:
            return _read_ros_file(root, path)
        if {"K", "k"} & keys.keys():
            return _read_ros_message(root, path)
        if "cam0" in keys:
            return _read_kalibr(root, name)
    except InputError as error:
        raise error if str(error).startswith(str(path)) else InputError(f"{path}: {error}") from error
    root.fail(
        "expected intrinsics with 'schema: optshape/camera/1', a ROS camera_info ('camera_matrix' or 'K'), or a Kalibr "
        f"camchain ('cam0'); found the keys: {', '.join(keys)}"
    )


def save_camera(path: str | Path, camera: CameraIntrinsics) -> None:
    """Write a camera file of this package's own form, which `load_camera` reads back with the same numbers.

    Raises:
        InputError: the file cannot be written.
    """
    document = {
        "schema": "optshape/camera/1",
        "name": camera.name,
        "model": camera.model,
        "width": int(camera.width),
        "height": int(camera.height),
        "K": camera.K.tolist(),
        "D": camera.D.tolist(),
    }
    write_yaml(path, document)


def _read_own(root: Node, path: Path) -> CameraIntrinsics:
    check_schema(root, "camera")
    fields = root.fields(required=["schema", "model", "width", "height", "K", "D"], optional=["name"])
    return CameraIntrinsics(
        name=fields["name"].text() if "name" in fields else path.stem,
        model=fields["model"].choice(list(DISTORTION_LENGTHS)),
        width=fields["width"].integer(1),
        height=fields["height"].integer(1),
        K=fields["K"].numbers(3, 3),
        D=_coefficients(fields["D"]),
    )


def _read_ros_file(root: Node, path: Path) -> CameraIntrinsics:
    matrices = ["camera_matrix", "distortion_coefficients"]
    sizes = ["image_width", "image_height"]
    unused = ["rectification_matrix", "projection_matrix"]
    fields = root.fields(required=[*sizes, "distortion_model", *matrices], optional=["camera_name", *unused])
    K, D = (fields[key].fields(["data"], ["rows", "cols"])["data"] for key in matrices)
    model = ROS_MODELS[fields["distortion_model"].choice(list(ROS_MODELS))]
    name = fields["camera_name"].text() if "camera_name" in fields else path.stem
    width, height = (fields[key].integer(1) for key in sizes)
    return CameraIntrinsics(name, model, width, height, K.numbers(9).reshape(3, 3), _ros_coefficients(D, model))


def _read_ros_message(root: Node, path: Path) -> CameraIntrinsics:
    k, d, r, p = ("K", "D", "R", "P") if "K" in root.value else ("k", "d", "r", "p")  # ROS 1; ROS 2
    unused = ["header", r, p]
    fields = root.fields(["width", "height", "distortion_model", k, d], [*unused, "binning_x", "binning_y", "roi"])
    for key in ("binning_x", "binning_y"):
        if key in fields and fields[key].integer() > 1:
            fields[key].expected("0 or 1: intrinsics of binned images are not read")
    if "roi" in fields:
        for key, node in fields["roi"].entries().items():
            if node.value not in (0, False):
                node.expected(f"no region of interest, so '{key}: 0'")
    model = ROS_MODELS[fields["distortion_model"].choice(list(ROS_MODELS))]
    width, height = fields["width"].integer(1), fields["height"].integer(1)
    D = _ros_coefficients(fields[d], model)
    return CameraIntrinsics(path.stem, model, width, height, fields[k].numbers(9).reshape(3, 3), D)


def _read_kalibr(root: Node, name: str | None) -> CameraIntrinsics:
    cameras = root.entries()
    if len(cameras) == 1:
        (name,) = cameras
    if name not in cameras:
        root.fail(f"it has the cameras {', '.join(cameras)}; expected one of these names, found {name!r}")
    fields = cameras[name].fields(
        required=["camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution"],
        optional=["rostopic", "cam_overlaps", "T_cn_cnm1", "T_cam_imu", "T_cam_lidar", "timeshift_cam_imu"],
    )
    fields["camera_model"].choice(["pinhole"])
    model = _KALIBR_MODELS[fields["distortion_model"].choice(list(_KALIBR_MODELS))]
    fx, fy, cx, cy = fields["intrinsics"].numbers(4)
    size = fields["resolution"].items()
    if len(size) != 2:
        fields["resolution"].expected("a list of width and height")
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    D = _coefficients(fields["distortion_coeffs"])
    return CameraIntrinsics(name, model, size[0].integer(1), size[1].integer(1), K, D)


def _coefficients(node: Node) -> Floats:
    return node.numbers(-1) if node.items() else np.zeros(0)


def _ros_coefficients(node: Node, model: str) -> Floats:
    """Coefficients of a CameraInfo; some drivers write a fisheye camera's four with zeros after them."""
    D = _coefficients(node)
    return D[:4] if model == "equidistant" and not D[4:].any() else D
