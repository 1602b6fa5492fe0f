"""What a file is, in a few facts: its form, fields and units, rings, times, frames, topics and spans."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optshape_graph.errors import InputError, OptshapeError
from optshape_graph.io.clouds import make_scan, read_columns
from optshape_graph.io.clouds.columns import Columns, roles
from optshape_graph.io.clouds.files import BEGINNINGS, ENDINGS
from optshape_graph.io.clouds.text import decode
from optshape_graph.io.files import read_bytes, read_head
from optshape_graph.scan import Scan

if TYPE_CHECKING:
    from optshape_graph.io.sensor_guess import Guess

Facts = dict[str, Any]
"""Names of facts to plain values: `form` is always there. `numbers` has them with units in the names, for programs."""

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm")
_VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".m4v")
_DOCUMENTS = (".yaml", ".yml", ".json", ".xml", ".ini")
_MOCAP = {".c3d": "C3D motion capture", ".mat": "Qualisys MAT motion capture", ".trc": "TRC motion capture",
          ".tsv": "Qualisys TSV motion capture"}  # fmt: skip


def describe(path: str | Path, columns: list[str] | None = None) -> Facts:
    """Return what a file or folder is.

    Args:
        path: any file that the package reads, or a folder: a bag, or a recording.
        columns: names of a cloud's columns that has none, in order.

    Raises:
        InputError: no such file, or of no form that is read; the message says what it looks like.
        MissingExtraError: the library that reads it is absent.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    head = b"" if path.is_dir() else read_head(path, 64)
    form = next((form for begin, form in BEGINNINGS.items() if head.startswith(begin)), None)
    suffix = path.suffix.lower()
    if path.is_dir() or form in ("packets", "bag") or suffix in (".bag", ".mcap", ".db3"):
        return _recording(path)
    if suffix in _IMAGES or head.startswith((b"\x89PNG", b"\xff\xd8\xff")):
        return _image(path)
    if suffix in _VIDEOS:
        return _video(path)
    if suffix in _MOCAP:
        return _mocap(path, _MOCAP[suffix])
    if suffix in _DOCUMENTS or head[:1] in (b"{", b"<"):
        return _document(path)
    if form is not None or (suffix in ENDINGS and ENDINGS[suffix] != "text"):
        return _cloud(path, columns)
    if b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: a binary file of no form that is read here; it begins with {head[:8].hex(' ')}")
    return _text(path, columns)


# Clouds


def _cloud(path: Path, names: list[str] | None = None) -> Facts:
    columns = read_columns(path, names)
    form = BEGINNINGS.get(next((b for b in BEGINNINGS if read_head(path, 64).startswith(b)), b""))
    kind = form or ENDINGS.get(path.suffix.lower(), "text")
    return {"form": f"cloud ({kind})", **cloud_facts(columns)}


def cloud_facts(columns: Columns) -> Facts:
    """Return what a cloud's columns hold: fields and what each is taken for, returns, rings, times, the sensor."""
    from optshape_graph.io.sensor_guess import guess_sensor

    known = roles(columns.values)
    taken = {role.column: (what, role.unit) for what, role in known.items()}
    fields = {
        name: " ".join(
            [_type(values), *([f"= {taken[name][0]}"] if name in taken else ["(not used)"]),
             *([f"x {taken[name][1]:g}"] if name in taken and taken[name][1] not in (None, 1.0) else [])]
        )
        for name, values in columns.values.items()
    }  # fmt: skip
    facts: Facts = {"points": int(next(iter(columns.values.values())).shape[0]) if columns.values else 0}
    if columns.height > 1:
        facts["organised"] = f"{columns.height} rows"
    facts["fields"] = fields
    try:
        scan = make_scan(columns)
    except InputError as error:
        return {**facts, "problem": str(error)}
    points = {"points": facts["points"]}
    facts |= scan_facts(scan)
    guess = guess_sensor(scan)
    facts["sensor"] = str(guess)
    facts["numbers"] = points | facts["numbers"] | _guessed(guess)
    return facts


def scan_facts(scan: Scan) -> Facts:
    """Return what a scan holds: returns, extent, rings, elevations, times."""
    distance = np.linalg.norm(scan.points, axis=1)
    elevation = np.degrees(np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1])))
    facts: Facts = {
        "returns": len(scan),
        "range": f"{distance.min():.2f} to {distance.max():.2f} m, median {np.median(distance):.2f}",
        "elevations": f"{elevation.min():.2f} to {elevation.max():.2f} deg",
    }
    if scan.ring is None:
        facts["rings"] = "none in the file (detect and map need them: --sensor recovers them from the elevations)"
    else:
        present = np.unique(scan.ring)
        facts["rings"] = f"{len(present)}, numbered {present[0]} to {present[-1]}"
    if scan.time is None:
        facts["times"] = "none"
    else:
        facts["times"] = f"{scan.time.min():.6f} to {scan.time.max():.6f} s, relative to the scan's stamp"
    facts["numbers"] = {
        "returns": len(scan),
        "range_m": [float(distance.min()), float(np.median(distance)), float(distance.max())],
        "elevations_deg": [float(elevation.min()), float(elevation.max())],
        "n_rings": 0 if scan.ring is None else len(np.unique(scan.ring)),
        "times_s": None if scan.time is None else [float(scan.time.min()), float(scan.time.max())],
    }
    return facts


def _guessed(guess: Guess) -> Facts:
    return {"sensor": guess.sensor.name if guess.sensor else None, "misfits_deg": guess.misfits}


def _type(values: np.ndarray[Any, Any]) -> str:
    shape = "" if values.ndim == 1 else f" x {values.shape[1:]}"
    return f"{values.dtype.name}{shape}"


# Documents


def _document(path: Path) -> Facts:
    from optshape_graph.io.foreign_cameras import read_foreign_document

    root = read_foreign_document(path)
    if not isinstance(root.value, dict):
        return {"form": "list of plain data", "entries": len(root.value) if isinstance(root.value, list) else 1}
    schema = root.value.get("schema")
    if isinstance(schema, str) and schema.startswith("optshape/"):
        return {"form": schema, **_own(path, schema.split("/")[1], root.value)}
    attempts: tuple[Callable[[Path], Facts | None], ...] = (_maker_table, _camera)
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
    """Facts of a file of this package's own forms; it is read, so that what is wrong with it is said."""
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
        return _camera(path)
    if kind == "session":
        session = load_session(path, allow_outside=True)
        return {
            "name": session.name, "views": len(session.views), "lidars": ", ".join(session.lidars),
            "cameras": ", ".join(session.cameras) or "none", "targets": ", ".join(session.targets),
            "images": sum(view.image is not None for view in session.views),
            "markers": len(session.mocap.markers.names) if session.mocap else 0,
        }  # fmt: skip
    return {key: _size(item) for key, item in value.items() if key != "schema"}


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


def _maker_table(path: Path) -> Facts | None:
    from optshape_graph.io.maker_tables import read_maker_table
    from optshape_graph.io.sensors import load_sensor, nearest_builtin

    table = read_maker_table(path)
    if table is None:
        return None
    alike = nearest_builtin(table.elevations)
    return {"form": "sensor, a maker's table of a unit's beams (--sensor takes it)", **_sensor_facts(load_sensor(path)),
            "alike": alike.name if alike else "none of the built-in ones"}  # fmt: skip


def _camera(path: Path) -> Facts:
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


# Text


def _text(path: Path, columns: list[str] | None) -> Facts:
    """A text file of whatever ending: motion capture, markers, a trajectory, a sensor's angles, stamps, or a cloud."""
    text = decode(read_bytes(path))
    start = text.lstrip()[:4096]
    first = next((line.strip() for line in text.splitlines() if line.strip()), "")
    lines = text.splitlines()
    if start.startswith(("NO_OF_", "Format Version", "PathFileType")) or any(
        line.strip(' ,"\t;') == "Trajectories" for line in lines[:2000]
    ):
        return _mocap(path, "motion capture")
    names = [word.strip().lower() for word in first.lstrip("#/ ").replace(";", ",").split(",")]
    if sorted(names) == ["frame", "marker", "x", "y", "z"]:
        return _markers(path)
    if {"u", "v"} <= set(names) and ("vertex" in names or {"y", "z"} <= set(names)):
        return {"form": "pixels of a target's points (session key `corners`)", "lines": len(lines) - 1}
    said: list[str] = []
    attempts: tuple[Callable[[], Facts], ...] = (
        lambda: _trajectory(path), lambda: _stamps(path, lines), lambda: _cloud(path, columns), lambda: _angles(path)
    )  # fmt: skip
    for attempt in attempts if columns is None else (lambda: _cloud(path, columns),):
        try:
            return attempt()
        except InputError as error:
            said.append(str(error).removeprefix(str(path)))
    raise InputError(f"{path}: text of no form that is read here. As a cloud{said[-2] if len(said) > 1 else said[-1]}")


def _trajectory(path: Path) -> Facts:
    from optshape_graph.io.trajectories import read_trajectory

    trajectory = read_trajectory(path)
    if len(trajectory) < 2:
        raise InputError(f"{path}: {len(trajectory)} poses")
    assert trajectory.stamps is not None  # what is read has them
    length = float(np.linalg.norm(np.diff(trajectory.poses[:, :3, 3], axis=0), axis=1).sum())
    return {
        "form": "trajectory (--odometry takes it)", "poses": len(trajectory), "length": f"{length:.3f} m",
        "stamps": _span(float(trajectory.stamps[0]), float(trajectory.stamps[-1])),
        "rate": f"{1 / np.median(np.diff(trajectory.stamps)):.1f} Hz",
        "numbers": {"stamps": len(trajectory), "span_s": [float(trajectory.stamps[0]), float(trajectory.stamps[-1])],
                    "length_m": length, "rate_hz": float(1 / np.median(np.diff(trajectory.stamps)))},
    }  # fmt: skip


def _stamps(path: Path, lines: list[str]) -> Facts:
    from optshape_graph.io.recordings.folders import STAMP_FILES
    from optshape_graph.io.times import parse_stamp

    if path.name not in STAMP_FILES:
        raise InputError(f"{path}: not called {', '.join(STAMP_FILES)}")
    words = [word for line in lines if line.strip() and not line.startswith("#") for word in line.split(",")[:1]]
    stamps = [stamp for word in words if (stamp := parse_stamp(word.strip().replace(" ", "T", 1))) is not None]
    facts: Facts = {"form": "stamps of the files beside it", "stamps": len(stamps), "span": "none"}
    facts["numbers"] = {"stamps": len(stamps)}
    if stamps:
        facts["span"] = _span(min(stamps), max(stamps))
        facts["numbers"]["span_s"] = [min(stamps), max(stamps)]
    return facts


def _angles(path: Path) -> Facts:
    facts = _maker_table(path) if path.suffix.lower() in (".csv", ".dat", ".txt") else None
    if facts is None:
        raise InputError(f"{path}: no table of a sensor's angles")
    return facts


def _markers(path: Path) -> Facts:
    from optshape_graph.io.markers import UNITS, read_markers

    fitting = {}
    for unit in UNITS:
        try:
            fitting[unit] = read_markers(path, unit)
        except InputError as error:
            said = error
    if not fitting:
        raise said
    markers = next(iter(fitting.values()))
    return {"form": "markers (session key `mocap`)", "unit, by their size": " or ".join(fitting),
            "frames": len(markers.frames), "markers": ", ".join(markers.names)}  # fmt: skip


def _mocap(path: Path, form: str) -> Facts:
    from optshape_graph.io.mocap import read_mocap, read_motive_bodies

    if path.suffix.lower() in (".csv", ".txt") and decode(read_bytes(path)).lstrip().startswith("Format Version"):
        times, bodies = read_motive_bodies(path)
        facts: Facts = {"form": "Motive motion capture", "rigid bodies": ", ".join(bodies) or "none"}
        try:
            return facts | {**_mocap_facts(read_mocap(path))}
        except InputError:
            return facts | {"markers": "none", "frames": len(times)}
    return {"form": form, **_mocap_facts(read_mocap(path))}


def _mocap_facts(recording: Any) -> Facts:
    gaps = 1 - float(recording.seen.mean())
    return {
        "markers": ", ".join(recording.markers), "frames": len(recording.times), "rate": f"{recording.rate:g} Hz",
        "times": _span(float(recording.times[0]), float(recording.times[-1])), "gaps": f"{gaps:.1%} of all positions",
        "numbers": {"stamps": len(recording.times), "span_s": [float(recording.times[0]), float(recording.times[-1])],
                    "rate_hz": float(recording.rate), "gap_share": gaps},
    }  # fmt: skip


# Images and recordings


def _image(path: Path) -> Facts:
    from optshape_graph.io.image_files import FORMATS, image_size

    size = image_size(read_bytes(path))
    if size is None:
        raise InputError(f"{path}: no image of a known form; expected {FORMATS}")
    return {"form": "image", "size": f"{size[0]} x {size[1]} pixels"}


def _video(path: Path) -> Facts:
    from optshape_graph.io.image_files import read_video

    for pixels in read_video(path):
        height, width = pixels.shape[:2]
        form = "video (a folder with it and timestamps.txt is a recording)"
        return {"form": form, "size": f"{width} x {height} pixels"}
    raise InputError(f"{path}: a video without a frame that can be decoded")


def _recording(path: Path) -> Facts:
    from optshape_graph.io.recordings import Recording

    recording = Recording(path)
    topics = recording.topics
    facts: Facts = {"form": _form_of_recording(path)}
    if span := recording.span:
        facts["recorded"] = _span(*span)
    facts["topics"] = {
        topic.name: f"{topic.kind}, {topic.type}" + ("" if topic.count is None else f", {topic.count} messages")
        for topic in topics
    }
    listed = [{"name": t.name, "kind": t.kind, "type": t.type, "count": t.count} for t in topics]
    facts["numbers"] = {"topics": listed} | ({"span_s": [float(t) for t in span]} if span else {})
    if not topics:
        facts["problem"] = "nothing in it that is read: a folder of clouds needs timestamps.txt"
    for topic in topics:
        if topic.kind == "scan":
            facts[f"first scan of {topic.name}"] = dict(_first_scan(recording, topic.name))
    return facts


def _first_scan(recording: Any, topic: str) -> Iterator[tuple[str, Any]]:
    from optshape_graph.io.sensor_guess import guess_sensor

    stream = recording.scans(topic)
    try:
        first = next(iter(stream), None)
    except OptshapeError as error:
        yield "problem", str(error)
        return
    if first is None:
        yield "problem", f"no usable scan; {stream.skipped}"
        return
    yield "stamp", f"{first.stamp:.6f} s"
    if frame := recording.mounting_frame(topic):
        yield "frame", frame
    facts, guess = scan_facts(first.value), guess_sensor(first.value)
    numbers = {"stamp_s": first.stamp, **facts.pop("numbers"), **_guessed(guess)}
    yield from facts.items()
    yield "sensor", str(guess)
    yield "numbers", numbers


def _form_of_recording(path: Path) -> str:
    if path.is_dir():
        return "ROS 2 bag" if (path / "metadata.yaml").is_file() else "recording: a folder"
    if path.suffix.lower() == ".bag":
        return "ROS 1 bag"
    return "captured packets" if path.suffix.lower() not in (".mcap", ".db3") else f"ROS 2 bag ({path.suffix[1:]})"


def _span(start: float, end: float) -> str:
    from datetime import UTC, datetime

    said = f"{start:.3f} to {end:.3f} s ({end - start:.3f} s)"
    if 1e8 < start < 1e11:
        said += f", from {datetime.fromtimestamp(start, UTC).isoformat(timespec='seconds')}"
    return said
