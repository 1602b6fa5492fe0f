"""The files of an extracted session: scans, images, markers, and what the session names."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.cameras import save_camera
from optshape_graph.io.clouds import write_scan
from optshape_graph.io.documents import write_yaml
from optshape_graph.io.files import write_atomically
from optshape_graph.io.recordings.images import CompressedImage, Image, encode_png
from optshape_graph.io.recordings.stream import BadMessage, Stream
from optshape_graph.io.sensors import save_sensor
from optshape_graph.io.targets import save_target
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

Track = Callable[[Iterable[Any], str, int | None], Iterable[Any]]
"""Yields items while it shows progress; arguments: items, what is done with them, their number (None: unknown)."""


@dataclass
class View:
    """A view in the making.

    Attributes:
        number: names its files and its marker frame.
        stamp: of its scan, seconds.
        document: its entry in the session file.
    """

    number: int
    stamp: float
    document: dict[str, Any] = field(default_factory=dict)


def write_images(images: Stream[Image], wanted: Mapping[float, View], folder: Path, track: Track) -> set[int]:
    """Write the wanted images; return the numbers of the views whose image does not decode."""
    broken = set()
    for image in track(images, f"writing {images.name}", images.expected):
        view = wanted.get(image.stamp)
        if view is None:
            continue
        try:
            content, suffix = _file_of(image.value)
        except BadMessage:
            broken.add(view.number)
            continue
        view.document["image"] = f"images/{view.number:06d}{suffix}"
        _write(folder / view.document["image"], content)
    return broken


def _file_of(image: Image) -> tuple[bytes, str]:
    """Return an image file's bytes and suffix: what the camera compressed stays as it is."""
    pixels = image.pixels()
    return (image.data, image.suffix) if isinstance(image, CompressedImage) else (encode_png(pixels), ".png")


def write_scans(scans: Stream[Scan], wanted: Mapping[float, View], folder: Path, markers: bool, track: Track) -> None:
    """Write the wanted scans; with markers, their views name the marker frame of the same number."""
    (folder / "scans").mkdir(parents=True, exist_ok=True)
    for scan in track(scans, f"writing {scans.name}", scans.expected):
        view = wanted.get(scan.stamp)
        if view is None:
            continue
        view.document |= {"scan": f"scans/{view.number:06d}.pcd", "stamp": view.stamp}
        if markers:
            view.document["mocap_frame"] = view.number
        write_scan(folder / view.document["scan"], scan.value)


def write_markers(path: Path, names: Sequence[str], frames: Mapping[int, Floats]) -> None:
    """Write frames of (M, 3) marker positions, metres; a marker that was not seen is left out."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frame", "marker", "x", "y", "z"])
    for frame, positions in frames.items():
        for name, position in zip(names, positions, strict=True):
            if np.isfinite(position).all():
                writer.writerow([frame, name, *(f"{x:.6f}" for x in position)])
    _write(path, text.getvalue().encode())


def write_session(
    path: Path,
    name: str,
    sensor: SensorModel,
    targets: Sequence[Target],
    camera: CameraIntrinsics | None,
    markers: bool,
    views: Sequence[View],
) -> None:
    """Write the session and what it names beside it, so that the folder can be moved.

    Raises:
        InputError: two targets of one name, or the folder cannot be written to.
    """
    if len({target.name for target in targets}) < len(targets):
        raise InputError(f"two targets of one name: {', '.join(target.name for target in targets)}")
    folder = path.parent
    document: dict[str, Any] = {"schema": "optshape/session/1", "name": name}
    save_sensor(folder / "lidar.sensor.yaml", sensor)
    document["sensor"] = "lidar.sensor.yaml"
    files = [f"target{k}.yaml" for k in range(len(targets))] if len(targets) > 1 else ["target.yaml"]
    for file, target in zip(files, targets, strict=True):
        save_target(folder / file, target)
    if len(targets) > 1:
        document["targets"] = {target.name: file for file, target in zip(files, targets, strict=True)}
    else:
        document["target"] = files[0]
    if camera is not None:
        save_camera(folder / "camera.yaml", camera)
        document["camera"] = "camera.yaml"
    if markers:
        document["mocap"] = {"file": "markers.csv", "units": "m"}
    document["views"] = [view.document for view in views]
    write_yaml(path, document)


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content)
