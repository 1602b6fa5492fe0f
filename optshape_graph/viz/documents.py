"""Scans and JSON results as points and lines in space, which the viewers draw."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io import load_target, read_scan
from optshape_graph.io.builtin import builtin_names
from optshape_graph.io.documents import Node, read_json
from optshape_graph.io.files import is_file
from optshape_graph.mapping.map import load_map
from optshape_graph.scan import Scan
from optshape_graph.se3 import apply, inverse
from optshape_graph.target import Target
from optshape_graph.viz.spatial import (
    Lines,
    Points,
    Spatial,
    axes,
    by_label,
    by_range,
    ellipsoid,
    frustum,
    outline,
    rgb,
)
from optshape_graph.viz.style import BLUE, COLOURS, INK, VERMILLION

Items = list[Points | Lines]


def spatial(path: str | Path, targets: Mapping[str, Target] | None = None) -> Spatial:
    """Return the points and lines in a file.

    Args:
        path: a scan, or a JSON result of `optshape estimate`, `detect`, `map`, `calibrate` or `simulate`.
        targets: templates by name, for results that name a target without its vertices; built-in targets are known.

    Raises:
        InputError: the file cannot be read, is of another form, or holds nothing with a place.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        return of_scan(read_scan(path))
    root = read_json(path)
    schema = _at(root, "schema").text()
    if schema == "optshape/camera/1" and "T_camera_lidar" in root.value:  # as version 0.1.0 wrote calibrations
        schema = "optshape/camera-calibration/1"
    kind = schema.removeprefix("optshape/").partition("/")[0]
    if schema != f"optshape/{kind}/1" or kind not in FORMS:
        forms = ", ".join(f"optshape/{name}/1" for name in FORMS)
        _at(root, "schema").fail(f"'{schema}' cannot be shown in space; expected one of: {forms}")
    return FORMS[kind](root, targets or {})


def of_scan(scan: Scan, name: str = "scan", step: int | None = None) -> Spatial:
    """Return the returns of a scan, coloured by range, and the LiDAR's axes."""
    return Spatial((axes("lidar", np.eye(4), 0.3, "LiDAR"), _returns(scan.points, name, step)))


def _estimate(root: Node, targets: Mapping[str, Target]) -> Spatial:
    items, steps, notes = _start()
    for k, entry in enumerate(_at(root, "scans").items()):
        name = _at(entry, "scan").text()
        steps.append(name)
        _add_scan(items, notes, root.path, name, k)
        if _at(entry, "T_lidar_target").value is None:
            notes.append(f"{name}: no pose ({_at(entry, 'reason').value})")
            continue
        T, vertices = _at(entry, "T_lidar_target").numbers(4, 4), _at(entry, "vertices").numbers(-1, 3)
        label = f"{_at(entry, 'target').text()}: {_at(entry, 'status').text()}"
        items += [outline("target/best", vertices, BLUE, label, k), axes("target/axes", T, step=k)]
        items.append(ellipsoid("target/3 sd", T, _at(entry, "covariance").numbers(6, 6), k))
        if _at(entry, "edge_points").value:
            labels = [node.integer() for node in _at(entry, "labels").items()]
            points = _at(entry, "edge_points").numbers(len(labels), 3)
            items.append(Points("target/edge points", points, by_label(labels), 0.015, k))
        rival = _at(_at(entry, "ambiguity"), "T_lidar_target")
        if rival.value is not None:
            moved = apply(rival.numbers(4, 4) @ inverse(T), vertices)
            items.append(outline("target/runner-up", moved, VERMILLION, step=k))
    return Spatial(tuple(items), tuple(steps), tuple(notes))


def _detect(root: Node, targets: Mapping[str, Target]) -> Spatial:
    items, steps, notes = _start()
    for k, entry in enumerate(_at(root, "scans").items()):
        name = _at(entry, "scan").text()
        steps.append(name)
        scan = _add_scan(items, notes, root.path, name, k)
        for j, found in enumerate(_at(entry, "targets").items()):
            T, target = _at(found, "T_lidar_target").numbers(4, 4), _at(found, "target").text()
            place, label = f"targets/{j} {target}", f"{target}: {_at(found, 'status').text()}"
            items += [axes(f"{place}/axes", T, label=label, step=k)]
            items.append(ellipsoid(f"{place}/3 sd", T, _at(found, "covariance").numbers(6, 6), k))
            template = _template(target, targets, notes)
            if template is not None:
                items.append(outline(f"{place}/outline", apply(T, template.vertices), BLUE, step=k))
            rows = [node.integer() for node in _at(found, "return_indices").items()]
            if scan is not None and rows and max(rows) < len(scan):
                items.append(Points(f"{place}/returns", scan.points[rows], rgb(VERMILLION), 0.015, k))
        centres = [_at(one, "centre").numbers(3) for one in _at(entry, "rejected").items()]
        if centres:
            items.append(Points("rejected", np.array(centres), rgb(INK), 0.05, k))
    return Spatial(tuple(items), tuple(steps), tuple(dict.fromkeys(notes)))


def _simulation(root: Node, targets: Mapping[str, Target]) -> Spatial:
    items, _, notes = _start()
    _add_scan(items, notes, root.path, _at(root, "scan").text(), None)
    for j, found in enumerate(_at(root, "targets").items()):
        name = _at(found, "target").text()
        items.append(outline(f"targets/{j} {name}", _at(found, "vertices").numbers(-1, 3), BLUE, name))
    return Spatial(tuple(items), notes=tuple(notes))


def _map(root: Node, targets: Mapping[str, Target]) -> Spatial:
    result = load_map(root.path)
    items: Items = [axes("world", np.eye(4), 1.0, "world")]
    for landmark in result.landmarks:
        place = f"landmarks/{landmark.id}"
        items.append(outline(f"{place}/outline", landmark.vertices, INK, landmark.id))
        items.append(axes(f"{place}/axes", landmark.T_world_target))
        items.append(ellipsoid(f"{place}/3 sd", landmark.T_world_target, landmark.covariance))
    for k, (name, trajectory) in enumerate(result.trajectories.items()):
        path = trajectory.poses[:, :3, 3]
        colour = rgb(COLOURS[k % len(COLOURS)])
        items.append(Points(f"trajectories/{name or 'robot'}/poses", path, colour, 0.03))
        if len(path) > 1:
            items.append(Lines(f"trajectories/{name or 'robot'}/path", (path,), colour, radius=0.01))
    return Spatial(tuple(items))


def _camera(root: Node, targets: Mapping[str, Target]) -> Spatial:
    cameras = {_at(node, "name").text(): _intrinsics(node) for node in _at(root, "cameras").items()}
    entries = root.entries()
    pairs = entries["extrinsics"].items() if "extrinsics" in entries else [root]
    placed = {_at(node, "lidar").text(): np.eye(4) for node in pairs[:1]}
    for node in entries["lidars"].items() if "lidars" in entries else []:
        if "T_base_lidar" in node.entries():
            placed[_at(node, "lidar").text()] = _at(node, "T_base_lidar").numbers(4, 4)
    items: Items = [axes(f"lidars/{name}", T, 0.2, name) for name, T in placed.items()]
    for node in pairs:
        lidar, camera = _at(node, "lidar").text(), _at(node, "camera").text()
        T = placed.get(lidar, np.eye(4)) @ _at(node, "T_lidar_camera").numbers(4, 4)
        if camera in cameras and lidar == next(iter(placed)):
            items += [axes(f"cameras/{camera}/axes", T, 0.1), frustum(f"cameras/{camera}/sees", T, cameras[camera])]
            items.append(ellipsoid(f"cameras/{camera}/3 sd", T, _at(node, "covariance_T_lidar_camera").numbers(6, 6)))
        if "next_placement" in node.entries():
            place = placed.get(lidar, np.eye(4)) @ _at(_at(node, "next_placement"), "T_lidar_target").numbers(4, 4)
            items.append(axes(f"next placement/{camera} {lidar}", place, 0.3, "put the target here next"))
    return Spatial(tuple(items))


def _mocap(root: Node, targets: Mapping[str, Target]) -> Spatial:
    T = _at(root, "T_lidar_mocap").numbers(4, 4)
    items: Items = [axes("lidar", np.eye(4), 0.3, "LiDAR"), axes("motion capture/axes", T, 0.3, "motion capture")]
    items.append(ellipsoid("motion capture/3 sd", T, _at(root, "covariance").numbers(6, 6)))
    layout, notes = _at(root, "marker_layout").numbers(-1, 3), []
    for entry in _at(root, "scans").items():
        name = _at(entry, "scan").text()
        if "T_lidar_target" not in entry.entries():
            notes.append(f"{name}: not shown, for the result does not say where the target was")
            continue
        T_lidar_target = _at(entry, "T_lidar_target").numbers(4, 4)
        markers = apply(T_lidar_target, layout)
        items.append(outline(f"targets/{name}/outline of the markers", markers, BLUE, name))
        items.append(Points(f"targets/{name}/markers", markers, rgb(VERMILLION), 0.01))
        items.append(axes(f"targets/{name}/axes", T_lidar_target, 0.2))
    return Spatial(tuple(items), notes=tuple(notes))


def _rig(root: Node, targets: Mapping[str, Target]) -> Spatial:
    items, base = list[Points | Lines](), _at(root, "base").text()
    for node in _at(root, "sensors").items():
        name = _at(node, "sensor").text()
        T = _at(node, "T_base_sensor").numbers(4, 4)
        items.append(axes(f"sensors/{name}/axes", T, 0.2, name))
    for node in _at(root, "transforms").items():
        if _at(node, "a").text() == base:
            place = f"sensors/{_at(node, 'b').text()}/3 sd"
            items.append(ellipsoid(place, _at(node, "T_a_b").numbers(4, 4), _at(node, "covariance").numbers(6, 6)))
    suggestion = root.entries().get("next_placement")
    if suggestion is not None and suggestion.value is not None:
        placed = {_at(n, "sensor").text(): _at(n, "T_base_sensor").numbers(4, 4) for n in _at(root, "sensors").items()}
        T = placed[_at(suggestion, "sensor").text()] @ _at(suggestion, "T_sensor_target").numbers(4, 4)
        items.append(axes("next placement", T, 0.3, "put the target here next"))
    return Spatial(tuple(items))


FORMS: dict[str, Callable[[Node, Mapping[str, Target]], Spatial]] = {
    "estimate": _estimate,
    "detect": _detect,
    "map": _map,
    "camera-calibration": _camera,
    "mocap": _mocap,
    "rig": _rig,
    "simulation": _simulation,
}
"""Functions that return the points and lines of a result, by the kind in its schema."""


def _start() -> tuple[Items, list[str], list[str]]:
    """Return empty lists of items, steps and notes."""
    return [axes("lidar", np.eye(4), 0.3, "LiDAR")], [], []


def _at(node: Node, key: str) -> Node:
    """Return the value under a required key; other keys are allowed."""
    entries = node.entries()
    if key not in entries:
        node.fail(f"the key '{key}' is missing; found only: {', '.join(entries) or 'nothing'}")
    return entries[key]


def _add_scan(items: Items, notes: list[str], document: Path, name: str, step: int | None) -> Scan | None:
    """Add the scan of a result, found by its path or beside the result."""
    for path in (Path(name), document.parent / name, document.parent / Path(name).name):
        if is_file(path):
            try:
                scan = read_scan(path)
            except InputError as error:
                notes.append(f"scan not shown: {error}")
                return None
            items.append(_returns(scan.points, "scan", step))
            return scan
    notes.append(f"scan not shown: {name} is neither there nor beside {document.name}")
    return None


def _returns(points: Floats, name: str, step: int | None) -> Points:
    return Points(name, points, by_range(points), step=step)


def _template(name: str, targets: Mapping[str, Target], notes: list[str]) -> Target | None:
    if name in targets:
        return targets[name]
    if name in builtin_names("target"):
        return load_target(name)
    notes.append(f"outline of '{name}' not shown: give its file with --target")
    return None


def _intrinsics(node: Node) -> CameraIntrinsics:
    D = _at(node, "D").items()
    return CameraIntrinsics(
        _at(node, "name").text(), _at(node, "model").text(), _at(node, "width").integer(),
        _at(node, "height").integer(), _at(node, "K").numbers(3, 3), np.array([one.number() for one in D]),
    )  # fmt: skip
