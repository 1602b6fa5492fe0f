"""Camera intrinsics: files of this package's own form, and of other programs."""

from __future__ import annotations

from pathlib import Path

from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.documents import Node, check_document, write_yaml
from optshape_graph.io.files import is_file
from optshape_graph.io.foreign_cameras import read_foreign_camera, read_foreign_document

SCHEMA = "optshape/camera/1"


def load_camera(path: str | Path, name: str | None = None) -> CameraIntrinsics:
    """Read intrinsics; the content of the file tells its form.

    - This package's own, with `schema: optshape/camera/1`.
    - Those of other programs: see `foreign_cameras`.

    Args:
        path: a YAML, JSON, XML or INI file; or FILE:NAME.
        name: which camera of a file with several; otherwise ignored.

    Raises:
        InputError: not readable, none of these forms, a camera model that this package does not have, or values that
            no camera has (see `CameraIntrinsics`).
    """
    path, name = _file_and_name(Path(path), name)
    root = read_foreign_document(path)
    try:
        if "schema" in root.entries():
            return _read_own(root, path)
        return read_foreign_camera(root, name)
    except InputError as error:
        raise error if str(error).startswith(str(path)) else InputError(f"{path}: {error}") from error


def save_camera(path: str | Path, camera: CameraIntrinsics) -> None:
    """Write a camera file of this package's own form, which `load_camera` reads back with the same numbers.

    Raises:
        InputError: the file cannot be written.
    """
    document = {
        "schema": SCHEMA,
        "name": camera.name,
        "model": camera.model,
        "width": int(camera.width),
        "height": int(camera.height),
        "K": camera.K.tolist(),
        "D": camera.D.tolist(),
    }
    write_yaml(path, document)


def _file_and_name(path: Path, name: str | None) -> tuple[Path, str | None]:
    """Return FILE and NAME of FILE:NAME, unless the whole is the path of a file."""
    file, colon, of_camera = path.name.rpartition(":")
    return (path.with_name(file), of_camera) if colon and file and not is_file(path) else (path, name)


def _read_own(root: Node, path: Path) -> CameraIntrinsics:
    if root.value["schema"] in (SCHEMA, "optshape/camera-calibration/1") and "T_camera_lidar" in root.value:
        root.fail(
            "a LiDAR-camera calibration, as `optshape calibrate camera` writes it; expected the intrinsics that it was "
            "made with"
        )
    check_document(root, "camera")
    fields = root.entries()
    return CameraIntrinsics(
        name=fields["name"].text() if "name" in fields else path.stem,
        model=fields["model"].text(),
        width=fields["width"].integer(),
        height=fields["height"].integer(),
        K=fields["K"].numbers(3, 3),
        D=[node.number() for node in fields["D"].items()],  # type: ignore[arg-type]  # the class makes the array
    )
