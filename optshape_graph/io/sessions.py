"""Session files, `schema: optshape/session/1`: which scans, images and marker frames belong together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError, expect
from optshape_graph.io.builtin import builtin_names
from optshape_graph.io.cameras import load_camera
from optshape_graph.io.documents import Node, read_document
from optshape_graph.io.markers import UNITS, Markers, read_markers, states_its_units
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target
from optshape_graph.se3 import as_transform
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

T = TypeVar("T")

MOCAP = "mocap"
"""Name of the motion capture's own frame, where it counts as a sensor."""

SMALLEST_BODY_M = 0.01
"""The markers of a body must spread this far from a line, metres."""


@dataclass(frozen=True)
class View:
    """One scan of a session and what was recorded with it; or an image, or a frame of markers, without one.

    Attributes:
        scan: the cloud's file, or None.
        lidar: which of the session's LiDARs made it, "" without a scan.
        targets: which of the session's targets may be in it.
        camera: which of the session's cameras made `image`, or None.
        image: the image's file, or None.
        target_points: a file with the target's returns, cropped by hand, or None.
        stamp: seconds, or None; on the session's clock, or on the sensor's if the view is `moving`.
        mocap_frame: the frame of the markers, or None.
        corners: a CSV file with rough pixels of the vertices of an unpatterned target in `image`, or None.
        moving: whether the target, or the platform, moves while the view is taken.
        where: file, line and key of the view, with which messages begin.
    """

    scan: Path | None
    lidar: str
    targets: tuple[str, ...]
    camera: str | None = None
    image: Path | None = None
    target_points: Path | None = None
    stamp: float | None = None
    mocap_frame: int | None = None
    corners: Path | None = None
    moving: bool = False
    where: str = field(default="", compare=False)

    @property
    def cloud(self) -> Path:
        """The cloud's file.

        Raises:
            InputError: the view has none.
        """
        if self.scan is None:
            raise InputError(f"{self.where}: the view has no scan; only `optshape calibrate rig` takes such a view")
        return self.scan


@dataclass(frozen=True, eq=False, repr=False)
class Mocap(Value):
    """Motion capture of a session.

    Attributes:
        markers: positions by frame and marker.
        vertices: by marker, the target and the index of the vertex that it is near. Taken from the session's map; or,
            without a map, from the names of the markers, if the session has one target and they are called corner0,
            corner1, ...; else empty: the markers are assigned by shape.
        bodies: by name, the rigid bodies on the platform: positions (3,) of the markers of each in its frame, metres.
    """

    markers: Markers
    vertices: Mapping[str, tuple[str, int]]
    bodies: Mapping[str, Mapping[str, Floats]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, repr=False)
class About(Value):
    """A rough pose of a sensor in another's frame.

    Attributes:
        a: name of one sensor.
        b: name of the other.
        T_a_b: (4, 4).
    """

    a: str
    b: str
    T_a_b: Floats


@dataclass(frozen=True, eq=False, repr=False)
class Session(Value):
    """A session, of either form of file.

    In the short form the one LiDAR, camera and target go by their own names.

    Attributes:
        name: what results call it.
        path: its file.
        lidars: sensors by name.
        cameras: intrinsics by name.
        targets: targets by name.
        views: in the file's order.
        mocap: motion capture, if there is any.
        static: names of the targets that stay where they are, in the world, in all views.
        platform_moves: whether what carries the sensors moves from view to view.
        initial: rough poses of sensors, as far as the file states them.
        sensor_files: of each LiDAR the sensor file, or the built-in sensor, as the session's file names it.
    """

    name: str
    path: Path
    lidars: Mapping[str, SensorModel]
    cameras: Mapping[str, CameraIntrinsics]
    targets: Mapping[str, Target]
    views: tuple[View, ...]
    mocap: Mocap | None = None
    static: frozenset[str] = frozenset()
    platform_moves: bool = False
    initial: tuple[About, ...] = ()
    sensor_files: Mapping[str, str] = field(default_factory=dict)


def load_session(path: str | Path, *, allow_outside: bool = False) -> Session:
    """Read a session, and the sensors, targets, intrinsics and markers that it names. Scans and images stay files.

    Paths start at the session's folder. The short form has `sensor`, `target`, `camera`. The general form has `lidars`,
    `targets`, `cameras`, and each view names those that it means; it need not if there is only one, and without
    `targets` any target may be in view.

    Args:
        path: the session's file.
        allow_outside: whether relative paths may lead farther than into the session's folder and the one above, by
            `..` or by a link. Absolute paths always may.

    Raises:
        InputError: not readable; a missing, unknown or wrong key; a file that is missing or wrong; a LiDAR, camera,
            target, vertex, marker or marker frame that is not there. The message names file, line and key.
    """
    expect("path", path, str, Path)
    path = Path(path)
    root = read_document(path, "session", anywhere=allow_outside)
    fields = root.entries()
    models = _named(fields, "sensor", "lidars", _sensor, lambda named: named[1].name)
    lidars = {name: model for name, (_, model) in models.items()}
    targets = _named(fields, "target", "targets", _target, lambda target: target.name)
    cameras = _named(fields, "camera", "cameras", _camera, lambda camera: camera.name)
    mocap = _mocap(fields["mocap"], targets) if "mocap" in fields else None
    static = frozenset(
        name
        for name, node in (fields["targets"].entries().items() if "targets" in fields else ())
        if isinstance(node.value, dict) and node.value.get("static", False)
    )
    listed, scan_key = (fields["views"], "scan") if "views" in fields else (fields["scans"], "file")
    views = tuple(_view(node, scan_key, lidars, targets, cameras, mocap) for node in listed.items())
    name = fields["name"].text() if "name" in fields else path.stem
    moves = "platform" in fields and fields["platform"].text() == "moving"
    sensors = (*lidars, *cameras, *sensors_of(mocap))
    if doubled := [name for name, times in Counter(sensors).items() if times > 1]:
        root.fail(f"two sensors called '{doubled[0]}'; expected a name for each LiDAR, camera and body")
    initial = tuple(_about(node, sensors) for node in fields["initial"].items()) if "initial" in fields else ()
    files = {name: file for name, (file, _) in models.items()}
    return Session(name, path, lidars, cameras, targets, views, mocap, static, moves, initial, files)


def sensors_of(mocap: Mocap | None) -> tuple[str, ...]:
    """Return the names of motion capture as sensors: its bodies or, without any, "mocap", its own frame."""
    return () if mocap is None else tuple(mocap.bodies) or (MOCAP,)


def _named(
    fields: Mapping[str, Node], one: str, several: str, read: Callable[[Node], T], name: Callable[[T], str]
) -> dict[str, T]:
    """Return what the short key, or the mapping of the general form, names; empty if there is neither."""
    if one in fields:
        item = read(fields[one])
        return {name(item): item}
    return {key: read(node) for key, node in fields[several].entries().items()} if several in fields else {}


def _loaded(node: Node, load: Callable[[str, Path], T], names: Sequence[str]) -> T:
    """Load what a built-in name or path stands for; errors begin with the line that names it."""
    if node.text().partition("@")[0] not in names:
        node.place()
    try:
        return load(node.text(), node.path.parent)
    except InputError as error:
        node.fail(str(error))


def _sensor(node: Node) -> tuple[str, SensorModel]:
    """What the file calls a sensor, and the sensor."""
    if isinstance(node.value, dict):  # of the general form
        node = node.at("sensor")
    return node.text(), _loaded(node, load_sensor, builtin_names("sensor"))


def _target(node: Node) -> Target:
    if isinstance(node.value, dict):  # of the general form
        node = node.at("target")
    return _loaded(node, load_target, builtin_names("target"))


def _camera(node: Node) -> CameraIntrinsics:
    name = str(node.key[-1]) if len(node.key) > 1 else None  # of the general form
    return _loaded(node, lambda text, folder: load_camera(folder / text, name), [])


def _view(
    node: Node,
    scan_key: str,
    lidars: Mapping[str, SensorModel],
    targets: Mapping[str, Target],
    cameras: Mapping[str, CameraIntrinsics],
    mocap: Mocap | None,
) -> View:
    fields = node.entries()
    if scan_key in fields and not lidars:
        fields[scan_key].fail("a scan, but the session names no LiDAR")
    if scan_key in fields and "lidar" not in fields and len(lidars) > 1:
        node.fail(f"the key 'lidar' is missing; the session has several: {', '.join(lidars)}")
    lidar = _reference(fields["lidar"], lidars, "LiDAR") if "lidar" in fields else next(iter(lidars), "")
    if "image" in fields and not cameras:
        fields["image"].fail("an image, but the session names no camera")
    if "image" in fields and "camera" not in fields and len(cameras) > 1:
        node.fail(f"the key 'camera' is missing; the session has several: {', '.join(cameras)}")
    camera = _reference(fields["camera"], cameras, "camera") if "camera" in fields else next(iter(cameras), None)
    seen = (
        tuple(_reference(item, targets, "target") for item in fields["targets"].items())
        if "targets" in fields
        else tuple(targets)
    )
    return View(
        scan=fields[scan_key].file() if scan_key in fields else None,
        lidar=lidar if scan_key in fields else "",
        targets=seen,
        camera=camera if "image" in fields else None,
        image=fields["image"].file() if "image" in fields else None,
        target_points=fields["target_points"].file() if "target_points" in fields else None,
        stamp=fields["stamp"].number() if "stamp" in fields else None,
        mocap_frame=_frame(fields["mocap_frame"], mocap) if "mocap_frame" in fields else None,
        corners=fields["corners"].file() if "corners" in fields else None,
        moving="moving" in fields and bool(fields["moving"].value),
        where=node.where,
    )


def _about(node: Node, sensors: Sequence[str]) -> About:
    fields = node.entries()
    a, b = (_reference(fields[key], sensors, "sensor") for key in ("a", "b"))
    if a == b:
        fields["b"].fail(f"'{b}' again; expected another sensor")
    try:
        return About(a, b, as_transform(fields["T_a_b"].numbers(4, 4), "transform"))
    except InputError as error:
        fields["T_a_b"].fail(str(error))


def _frame(node: Node, mocap: Mocap | None) -> int:
    frame = node.integer()
    if mocap is None:
        node.fail("a marker frame, but the session has no motion capture ('mocap')")
    frames = mocap.markers.frames
    if frame not in frames:
        node.fail(f"no marker frame {frame}; the file has {len(frames)} frames, {min(frames)} to {max(frames)}")
    return frame


def _mocap(node: Node, targets: Mapping[str, Target]) -> Mocap:
    fields = node.entries()
    file = fields["file"].file()
    if "units" not in fields and not states_its_units(file):
        node.fail(
            f"the key 'units' is missing; expected one of {', '.join(UNITS)}, as {file.name} does not state its own"
        )
    markers = read_markers(file, fields["units"].text() if "units" in fields else "m")
    bodies = _bodies(fields["bodies"], markers) if "bodies" in fields else {}
    if "markers" not in fields:
        return Mocap(markers, _corners(markers, targets), bodies)
    vertices: dict[str, tuple[str, int]] = {}
    for marker, place in fields["markers"].entries().items():
        _known(place, marker, markers)
        target, vertex = _reference(place.at(0), targets, "target"), place.at(1).integer()
        if vertex >= len(targets[target]):
            place.at(1).expected(f"a vertex of '{target}', 0 to {len(targets[target]) - 1}")
        if (target, vertex) in vertices.values():
            place.fail(f"a second marker at vertex {vertex} of '{target}'")
        vertices[marker] = (target, vertex)
    return Mocap(markers, vertices, bodies)


def _bodies(node: Node, markers: Markers) -> dict[str, dict[str, Floats]]:
    bodies: dict[str, dict[str, Floats]] = {}
    for name, body in node.entries().items():
        places = {marker: place.numbers(3) for marker, place in body.entries().items()}
        for marker, place in body.entries().items():
            _known(place, marker, markers)
        points = np.array(list(places.values()))
        if np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] < SMALLEST_BODY_M:
            body.fail("its markers lie on one line; expected three at least that span a triangle")
        bodies[name] = places
    return bodies


def _known(node: Node, marker: str, markers: Markers) -> None:
    if marker not in markers.names:
        node.fail(f"no marker '{marker}'; the file has: {', '.join(markers.names)}")


def _corners(markers: Markers, targets: Mapping[str, Target]) -> dict[str, tuple[str, int]]:
    """Return the vertices of markers called corner0, corner1, ..., if there is one target and none is missing."""
    if len(targets) != 1:
        return {}
    ((name, target),) = targets.items()
    corners = {f"corner{k}": (name, k) for k in range(len(target))}
    named = {marker: corners[marker] for marker in markers.names if marker in corners}
    return named if len(named) in (len(target), len(markers.names)) else {}


def _reference(node: Node, known: Iterable[str], kind: str) -> str:
    name = node.text()
    if name not in known:
        node.fail(f"no {kind} '{name}'; the session has: {', '.join(known) or 'none'}")
    return name
