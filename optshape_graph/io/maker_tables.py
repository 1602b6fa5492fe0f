"""The makers' own tables of a unit's beams: Ouster, Velodyne, Hesai, RoboSense."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.errors import InputError
from optshape_graph.io.clouds.text import decode
from optshape_graph.io.documents import Node, read_json
from optshape_graph.io.files import read_bytes
from optshape_graph.io.yaml_core import parse_yaml

_LOG = logging.getLogger(__name__)

LARGEST = 16 << 20
"""Bytes that such a file has at most."""

OFFSET_M = 0.02
"""A warning is given if beams start this far above each other: in the sensor model all start at one point."""


@dataclass(frozen=True, eq=False, repr=False)
class MakerTable(Value):
    """Beams of a unit.

    Attributes:
        elevations: (R,) rad, the lowest first.
        azimuth_offsets: (R,) rad, counter-clockwise; None: there are none.
        azimuth_step: rad between two firings; None: the file does not say.
    """

    elevations: Floats
    azimuth_offsets: Floats | None = None
    azimuth_step: float | None = None


def read_maker_table(path: Path) -> MakerTable | None:
    """Return the beams in a maker's file; None: it is not such a file.

    Raises:
        InputError: such a file, with angles that no sensor has.
    """
    suffix = path.suffix.lower()
    if suffix == ".json":
        return _ouster(read_json(path))
    if suffix in (".csv", ".dat", ".txt"):
        return _angles(path, decode(read_bytes(path, LARGEST)))
    if suffix == ".xml":
        raise InputError(
            f"{path}: XML; of Velodyne, the calibration YAML of the ROS driver is read (gen_calibration.py)"
        )
    text = decode(read_bytes(path, LARGEST))
    if "lasers:" in text and "schema:" not in text:
        value, lines = parse_yaml(path, text, foreign=True)
        return _velodyne(Node(value, path, (), lines))
    return None


def _ouster(root: Node) -> MakerTable | None:
    """Metadata of firmware 1 (flat) and 2 and 3 (nested); angles in degrees, the uppermost beam first, clockwise."""
    if not isinstance(root.value, dict):
        return None
    beams = root.entries().get("beam_intrinsics", root)
    if not isinstance(beams.value, dict) or "beam_altitude_angles" not in beams.value:
        return None
    fields = beams.entries()
    elevations = fields["beam_altitude_angles"].numbers(-1)
    offsets = -fields["beam_azimuth_angles"].numbers(-1) if "beam_azimuth_angles" in fields else None
    if offsets is not None and len(offsets) != len(elevations):
        fields["beam_azimuth_angles"].expected(f"{len(elevations)} angles, as many as of altitude")
    columns = _find(root.value, "columns_per_frame") or str(_find(root.value, "lidar_mode") or "").partition("x")[0]
    try:
        step = np.radians(360 / int(columns))
    except (ValueError, ZeroDivisionError):
        step = None
    return _table(root.path, elevations, offsets, step)


def _find(value: Any, key: str, depth: int = 0) -> Any:
    """Return the first value under a key, at any depth."""
    if isinstance(value, dict) and depth < 6:
        if key in value:
            return value[key]
        return next((found for item in value.values() if (found := _find(item, key, depth + 1)) is not None), None)
    return None


def _velodyne(root: Node) -> MakerTable:
    """Calibration YAML of the ROS driver: radians; it subtracts rot_correction from the clockwise azimuth."""
    lasers = [node.fields(["vert_correction"]) for node in root.fields(["lasers"])["lasers"].items()]
    if not lasers:
        root.at("lasers").expected("at least one laser")

    def each(key: str) -> Floats:
        return np.array([laser[key].number() if key in laser else 0.0 for laser in lasers])

    height = np.ptp(each("vert_offset_correction") * np.cos(each("vert_correction")))
    if height > OFFSET_M and len(lasers) > 32:
        _LOG.warning("%s: its lasers start up to %.0f mm above each other; all are taken to start at the origin",
                     root.path, 1e3 * height)  # fmt: skip
    rotations = each("rot_correction")
    elevations, offsets = np.degrees(each("vert_correction")), np.degrees(rotations) if rotations.any() else None
    return _table(root.path, elevations, offsets, None)


def _angles(path: Path, text: str) -> MakerTable:
    """Angle corrections: `channel,elevation,azimuth` (Hesai) or `elevation,azimuth` (RoboSense); degrees, clockwise."""
    rows: list[list[float]] = []
    for line in text.splitlines():
        try:
            row = [float(cell) for cell in line.replace(";", ",").split(",") if cell.strip()]
        except ValueError:
            continue  # the line of names, or the maker's marks
        if row:
            rows.append(row)
    widths = {len(row) for row in rows}
    if len(rows) < 2 or len(widths) != 1 or widths.pop() not in (1, 2, 3):
        raise InputError(
            f"{path}: expected a maker's angles, a line of channel,elevation,azimuth (Hesai) or elevation,azimuth "
            f"(RoboSense) for each beam; found {text.strip()[:60]!r}"
        )
    table = np.array(rows)
    if table.shape[1] == 3:
        table = table[:, 1:]
    offsets = -table[:, 1] if table.shape[1] == 2 and table[:, 1].any() else None
    return _table(path, table[:, 0], offsets, None)


def _table(path: Path, elevations: Floats, offsets: Floats | None, step: float | None) -> MakerTable:
    """Return the table of angles in degrees, sorted by elevation."""
    if not (np.isfinite(elevations).all() and np.abs(elevations).max() < 90):
        raise InputError(f"{path}: elevation {np.nanmax(np.abs(elevations)):g} deg; expected all within 90 deg")
    order = np.argsort(elevations, kind="stable")
    return MakerTable(np.radians(elevations[order]), None if offsets is None else np.radians(offsets[order]), step)
