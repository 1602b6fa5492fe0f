"""Facts about documents (YAML, JSON, XML): files of this package, sensors and cameras of others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.describe.facts import Facts


def document_facts(path: Path) -> Facts:
    """Return what a document holds, as the form that its schema names, or else as a sensor's table or as cameras.

    Raises:
        InputError: no form reads it, or what it holds is wrong.
    """
    from optshape_graph.io.foreign_cameras import read_foreign_document

    root = read_foreign_document(path)
    if not isinstance(root.value, dict):
        return {"form": "list of plain data", "entries": len(root.value) if isinstance(root.value, list) else 1}
    schema = root.value.get("schema")
    if isinstance(schema, str) and schema.startswith("optshape/"):
        return {"form": schema, **_own(path, schema.split("/")[1], root.value)}
    attempts: tuple[Callable[[Path], Facts | None], ...] = (maker_table_facts, camera_facts)
    said = []
    for attempt in attempts:
        try:
            facts = attempt(path)
        except InputError as error:
            said.append(str(error))
            continue
        if facts is not None:
            return facts
    raise InputError(f"{path}: a document of no form that is read here: {said[-1].removeprefix(f'{path}')}")


def _own(path: Path, kind: str, value: dict[str, Any]) -> Facts:
    """Return the facts of a file of this package's own forms. It is read whole, so that an error in it is reported."""
    from optshape_graph.io.sensors import load_sensor
    from optshape_graph.io.sessions import load_session
    from optshape_graph.io.targets import load_target

    if kind == "target":
        target = load_target(path)
        return {"name": target.name, "vertices": len(target), "area": f"{target.area:.4f} m2",
                "printed on it": _printed(target)}  # fmt: skip
    if kind == "sensor":
        return _sensor_facts(load_sensor(path))
    if kind == "camera" and "T_camera_lidar" not in value:
        return camera_facts(path)
    if kind == "session":
        session = load_session(path, allow_outside=True)
        return {
            "name": session.name, "views": len(session.views), "lidars": ", ".join(session.lidars),
            "cameras": ", ".join(session.cameras) or "none", "targets": ", ".join(session.targets),
            "images": sum(view.image is not None for view in session.views),
            "markers": len(session.mocap.markers.names) if session.mocap else 0,
        }  # fmt: skip
    facts = {key: _size(item) for key, item in value.items() if key != "schema"}
    if isinstance(scans := value.get("scans"), list):
        statuses = Counter(str(scan["status"]) for scan in scans if isinstance(scan, dict) and "status" in scan)
        facts["scans"] += "".join(f", {count} {status}" for status, count in statuses.items())
    return facts


def _printed(target: Any) -> str:
    if target.chessboard is not None:
        z, y = target.chessboard.inner_corners
        return f"chessboard of {z} x {y} inner corners, squares of {target.chessboard.square:g} m"
    return f"{len(target.tags.centres)} tags" if target.tags is not None else "nothing"


def _size(item: Any) -> Any:
    if isinstance(item, list):
        return f"list of {len(item)}"
    return f"{len(item)} entries" if isinstance(item, dict) else item


def _sensor_facts(sensor: Any) -> Facts:
    elevation = np.degrees(sensor.elevations)
    step = "not stated" if sensor.azimuth_step is None else f"{np.degrees(sensor.azimuth_step):.4f} deg"
    span = f"{elevation[0]:.3f} to {elevation[-1]:.3f} deg"
    return {"name": sensor.name, "rings": sensor.n_rings, "elevations": span, "azimuth step": step,
            "numbers": {"n_rings": sensor.n_rings, "elevations_deg": [float(elevation[0]), float(elevation[-1])],
                        "azimuth_step_deg": None if sensor.azimuth_step is None
                        else float(np.degrees(sensor.azimuth_step))}}  # fmt: skip


def maker_table_facts(path: Path) -> Facts | None:
    """Return the facts of a maker's table of a sensor's beams; None: the file is no such table.

    Raises:
        InputError: a table with values that no sensor has.
    """
    from optshape_graph.io.maker_tables import read_maker_table
    from optshape_graph.io.sensors import load_sensor, nearest_builtin

    table = read_maker_table(path)
    if table is None:
        return None
    alike = nearest_builtin(table.elevations)
    return {"form": "sensor, a maker's table of a unit's beams (--sensor takes it)", **_sensor_facts(load_sensor(path)),
            "alike": alike.name if alike else "none of the built-in ones"}  # fmt: skip


def camera_facts(path: Path) -> Facts:
    """Return the intrinsics of the cameras in a file of any form that `load_camera` reads.

    Raises:
        InputError: as `load_camera`.
    """
    from optshape_graph.io.cameras import load_camera
    from optshape_graph.io.foreign_cameras import camera_names, read_foreign_document

    names = camera_names(read_foreign_document(path))
    cameras = [load_camera(path, name) for name in names] if names else [load_camera(path)]
    return {
        "form": "camera intrinsics",
        "cameras": {
            camera.name: f"{camera.model}, {camera.width} x {camera.height}, "
            f"f ({camera.K[0, 0]:.1f}, {camera.K[1, 1]:.1f}), {len(camera.D)} distortion coefficients"
            for camera in cameras
        },
    }
