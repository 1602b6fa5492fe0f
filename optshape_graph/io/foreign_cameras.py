"""Camera intrinsics in files of other programs: camera matrix, distortion and image size under their names.

| form | told by |
|---|---|
| ROS `camera_info` files (`ost.yaml`) and OpenCV FileStorage (YAML, XML, JSON) | a camera matrix |
| ROS CameraInfo messages, as `topic echo` prints them | `K` or `k` |
| ROS `ost.ini`, `ost.txt` | the section `[image]` |
| Kalibr and OpenVINS camchains | cameras, each with `intrinsics` and `resolution` |
| EuRoC `sensor.yaml` | `intrinsics` and `resolution` |
| files with a number for each of fx, fy, cx, cy (Apollo, camodocal and VINS, ORB-SLAM) | `fx` or `mu` |

Other keys are ignored. Case, underscores and dots in the names of keys are ignored, too.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.camera import DISTORTION_LENGTHS, CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.documents import LARGEST_YAML, Node, read_json
from optshape_graph.io.files import read_text
from optshape_graph.io.yaml_core import parse_yaml

_MODELS = {
    "pinhole": ("", "none", "pinhole", "plumbbob", "radtan", "radtan5", "radtan8", "radialtangential",
                "radialtangential8", "rationalpolynomial", "rational", "brown", "brownconrady",
                "inversebrownconrady", "modifiedbrownconrady"),
    "equidistant": ("equidistant", "equidistant4", "equi", "fisheye", "opencvfisheye", "kannalabrandt",
                    "kannalabrandt4", "kannalabrandt8"),
}  # fmt: skip
"""This package's models, and the names that others use for them, as `_plain` returns them."""

_KNOWN = (
    "expected plumb_bob, radtan, rational_polynomial (OpenCV's pinhole models) or equidistant, fisheye (OpenCV's "
    "fisheye model)"
)

_MATRIX = ("cameramatrix", "intrinsicmatrix", "mtx", "k")
_DISTORTION = ("distortioncoefficients", "distortioncoefficents", "distortioncoeffs", "distcoeffs", "distcoeff",
               "distortion", "dist", "d")  # fmt: skip
_WIDTH = ("imagewidth", "width", "camerawidth", "camera1width")
_HEIGHT = ("imageheight", "height", "cameraheight", "camera1height")
_SIZE = ("resolution", "imagesize", "imageresolution", "cameraresolution", "size")
_FOCAL = ("fx", "camerafx", "camera1fx", "mu")
_EXPECTED = (
    "expected intrinsics with 'schema: optshape/camera/1', a camera matrix (ROS, OpenCV), 'intrinsics' and "
    "'resolution' (Kalibr, OpenVINS, EuRoC), or fx, fy, cx, cy"
)


def read_foreign_document(path: Path) -> Node:
    """Read YAML, JSON, XML of OpenCV or INI of ROS; OpenCV's first line and tags in YAML are ignored.

    Raises:
        InputError: not readable, or none of these.
    """
    if path.suffix.lower() == ".json":
        return read_json(path)
    text = read_text(path, LARGEST_YAML)
    if text.lstrip().startswith("<"):
        return Node(_opencv_xml(path, text), path)
    if any(line.strip() == "[image]" for line in text.splitlines()[:20]):
        return Node(_ros_ini(path, text), path)
    value, lines = parse_yaml(path, text, foreign=True)
    return Node(value, path, (), lines)


def camera_names(root: Node) -> list[str]:
    """Return the names of a document's cameras, if it has named cameras; else none."""
    if not isinstance(root.value, dict):
        return []
    return [key for key, node in root.entries().items() if _first(_named(node), ("intrinsics", *_MATRIX))]


def read_foreign_camera(root: Node, name: str | None) -> CameraIntrinsics:
    """Return the camera of another program's file.

    Args:
        root: the document.
        name: which camera of several.

    Raises:
        InputError: no camera in it, or one with a model or values that this package does not have.
    """
    fields = _named(root)
    if _first(fields, _MATRIX) or _first(fields, _FOCAL) or _first(fields, ("intrinsics",)):
        return _camera(root, fields, root.path.stem)
    if projection := _first(fields, ("projectionparameters",)):  # camodocal nests them, and the distortion
        nested = [_first(fields, (key,)) for key in ("distortionparameters", "mirrorparameters")]
        for node in (projection, *(node for node in nested if node)):
            fields = {**_named(node), **fields}
        return _camera(root, fields, root.path.stem)
    cameras = {key: root.at(key) for key in camera_names(root)}
    if not cameras:
        root.fail(f"{_EXPECTED}; found the keys: {', '.join(root.entries())}")
    if len(cameras) == 1:
        (name,) = cameras
    if name not in cameras:
        asked = f"no camera '{name}'; " if name else ""
        root.fail(
            f"{asked}it has the cameras {', '.join(cameras)}: name one, as {root.path.name}:{next(iter(cameras))}"
        )
    return _camera(cameras[name], _named(cameras[name]), name)


def make_camera(name: str, model: str, width: int, height: int, K: Any, D: Iterable[float]) -> CameraIntrinsics:
    """Return a camera whose model goes by another program's name.

    Zeros beyond the model's coefficients are dropped; if all coefficients are zero, the camera has none.

    Args:
        name: of the camera.
        model: as the other program calls it; "": the number of coefficients tells.
        width: pixels.
        height: pixels.
        K: nine numbers, or 3 x 3.
        D: coefficients in OpenCV's order.

    Raises:
        InputError: a model that is not known here, or values that no camera has.
    """
    own = _own_model(model)
    if own is None:
        raise InputError(f"camera '{name}': model '{model}'; {_KNOWN}")
    coefficients = np.array(list(D), dtype=float)
    used = len(np.trim_zeros(coefficients, "b")) if len(coefficients) else 0
    lengths = [n for n in DISTORTION_LENGTHS[own] if used <= n <= len(coefficients)]
    if len(coefficients) not in DISTORTION_LENGTHS[own] and lengths:
        coefficients = coefficients[: max(lengths)]
    elif own == "pinhole" and 0 < len(coefficients) < 4:  # k1, k2 alone
        coefficients = np.pad(coefficients, (0, 4 - len(coefficients)))
    elif own == "equidistant" and not len(coefficients):
        coefficients = np.zeros(4)
    return CameraIntrinsics(name, own, width, height, np.asarray(K, float).reshape(3, 3), coefficients)


def _camera(node: Node, fields: dict[str, Node], name: str) -> CameraIntrinsics:
    """Return the camera whose parameters a mapping has, under any of the known names."""
    _refuse_cropped(fields)
    width, height = _image_size(node, fields)
    model = _model(fields)
    K = _matrix(node, fields)
    named = _first(fields, ("cameraname",))
    if named is not None and isinstance(named.value, str) and named.value:
        name = named.value
    try:
        return make_camera(name, model, width, height, K, _coefficients(fields, model))
    except InputError as error:
        node.fail(str(error))


def _model(fields: dict[str, Node]) -> str:
    """Return the file's name of the model: that of the projection if it is not a pinhole, else of the distortion."""
    projection = _first(fields, ("cameramodel", "projectionmodel", "modeltype", "cameratype", "camera1type", "model"))
    distortion = _first(fields, ("distortionmodel", "distortiontype"))
    fisheye = _first(fields, ("fisheyemodel", "fisheye"))
    if fisheye is not None and fisheye.value in (1, True):
        return "fisheye"
    for node in (projection, distortion):
        if node is None or node.value == "":
            continue
        own = _own_model(node.text())
        if own is None:
            node.fail(f"{_KNOWN}, found '{node.text()}'")
        if own != "pinhole" or node is distortion:
            return node.text()
    return ""


def _matrix(node: Node, fields: dict[str, Node]) -> Floats:
    matrix = _first(fields, _MATRIX)
    if matrix is not None:
        numbers = _flat(matrix)
        if len(numbers) != 9:
            matrix.fail(f"expected a camera matrix of 3 x 3 numbers, found {len(numbers)}")
        return np.reshape(numbers, (3, 3))
    intrinsics = _first(fields, ("intrinsics",))
    if intrinsics is not None:
        numbers = _flat(intrinsics)
        if len(numbers) != 4:
            intrinsics.fail(f"expected fx, fy, cx, cy, found {len(numbers)} numbers")
        fx, fy, cx, cy = numbers
    else:
        names = (("fx", "mu"), ("fy", "mv"), ("cx", "u0"), ("cy", "v0"))
        fx, fy, cx, cy = (_one(node, fields, several) for several in names)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _one(node: Node, fields: dict[str, Node], names: Sequence[str]) -> float:
    found = _first(fields, [prefix + name for prefix in ("", "camera", "camera1") for name in names])
    if found is None:
        node.fail(f"the key '{names[0]}' is missing; found the keys: {', '.join(node.entries())}")
    return found.number()


def _coefficients(fields: dict[str, Node], model: str) -> list[float]:
    several = _first(fields, _DISTORTION)
    if several is not None:
        return _flat(several)
    if _plain(model) in _MODELS["equidistant"]:  # camodocal counts from k2
        counted: tuple[str, ...] = (
            ("k2", "k3", "k4", "k5") if "k5" in fields and "k1" not in fields else ("k1", "k2", "k3", "k4")
        )
    else:
        counted = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    each = [_first(fields, [prefix + name for prefix in ("", "camera", "camera1")]) for name in counted]
    last = max((k for k, node in enumerate(each) if node is not None), default=-1)
    return [node.number() if node is not None else 0.0 for node in each[: last + 1]]


def _image_size(node: Node, fields: dict[str, Node]) -> tuple[int, int]:
    width, height, size = _first(fields, _WIDTH), _first(fields, _HEIGHT), _first(fields, _SIZE)
    if (width is None or height is None) and size is not None:
        if isinstance(size.value, dict):
            inner = _named(size)
            width, height = _first(inner, _WIDTH), _first(inner, _HEIGHT)
        elif isinstance(size.value, list) and len(size.value) == 2:
            width, height = size.at(0), size.at(1)
    if width is None or height is None:
        node.fail(
            "intrinsics without the image's size; expected image_width and image_height beside them, found the keys: "
            + ", ".join(node.entries())
        )
    return _count(width), _count(height)


def _count(node: Node) -> int:
    value = node.number()
    if value < 1 or value != int(value):
        node.expected("a number of pixels")
    return int(value)


def _refuse_cropped(fields: dict[str, Node]) -> None:
    """Refuse intrinsics of binned or cropped images, which CameraInfo may be."""
    for key in ("binningx", "binningy"):
        if key in fields and fields[key].number() > 1:
            fields[key].expected("0 or 1: intrinsics of binned images are not read")
    if "roi" in fields and isinstance(fields["roi"].value, dict):
        for key, node in fields["roi"].entries().items():
            if node.value not in (0, False):
                node.expected(f"no region of interest, so '{key}: 0'")


def _flat(node: Node) -> list[float]:
    """Return all numbers of a matrix: `data` of a mapping, or a list, nested or not."""
    if isinstance(node.value, dict):
        return _flat(node.fields(["data"])["data"])
    if isinstance(node.value, list):
        return [number for item in node.items() for number in _flat(item)]
    return [node.number()]


def _named(node: Node) -> dict[str, Node]:
    """Return the values of a mapping by the plain form of their keys; empty for anything else."""
    if not isinstance(node.value, dict):
        return {}
    return {_plain(key): value for key, value in node.entries().items()}


def _first(fields: dict[str, Node], names: Iterable[str]) -> Node | None:
    return next((fields[name] for name in names if name in fields and fields[name].value is not None), None)


def _own_model(name: str) -> str | None:
    return next((own for own, names in _MODELS.items() if _plain(name) in names), None)


def _plain(name: str) -> str:
    return re.sub(r"[\s_.\-]", "", name).lower()


def _opencv_xml(path: Path, text: str) -> dict[str, Any]:
    """Return an OpenCV FileStorage in XML as plain data."""
    from xml.etree import ElementTree

    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise InputError(f"{path}: XML with a document type or CDATA; expected an OpenCV file ('opencv_storage')")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: not XML ({error})") from error
    if root.tag != "opencv_storage":
        raise InputError(f"{path}: XML of '{root.tag[:40]}'; expected an OpenCV file ('opencv_storage')")

    def value(element: Any, depth: int = 0) -> Any:
        if len(element) and depth < 20:
            return {child.tag: value(child, depth + 1) for child in element}
        words = (element.text or "").strip().strip('"')
        numbers = [_number(word) for word in words.split()]
        if numbers and None not in numbers:
            return numbers[0] if len(numbers) == 1 and element.tag != "data" else numbers
        return words

    return {child.tag: value(child) for child in root}


def _number(word: str) -> float | int | None:
    try:
        return int(word) if word.lstrip("-").isdecimal() and len(word) < 18 else float(word)
    except ValueError:
        return None


def _ros_ini(path: Path, text: str) -> dict[str, Any]:
    """Return the file that ROS's calibrator writes beside `ost.yaml`: titles, each followed by lines of numbers."""
    found: dict[str, Any] = {}
    title = ""
    for line in text.splitlines():
        words = line.split("#")[0].split("=")[-1].split() if "=" in line else line.split("#")[0].split()
        if not words:
            continue
        if line.strip().startswith("["):
            name = line.strip().strip("[]")
            if name not in ("image", "externals"):
                found["camera_name"] = name
        elif all(_number(word) is not None for word in words):
            found.setdefault(title, []).extend(_number(word) for word in words)
        else:
            title = line.split("=")[0].strip().lower()
            numbers = [_number(word) for word in words]
            if "=" in line and None not in numbers:
                found[title] = numbers
    for key in ("width", "height"):
        if len(found.get(key, [])) != 1:
            raise InputError(f"{path}: expected a number under '{key}', as ROS's camera_calibration writes it")
        found[key] = found[key][0]
    return found
