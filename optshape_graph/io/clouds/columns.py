"""Named columns, as a cloud's file holds them, and the names that tell what a column is."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Value
from optshape_graph.errors import InputError


@dataclass(frozen=True, eq=False, repr=False)
class Columns(Value):
    """Named columns of a cloud, as recorded.

    Attributes:
        values: each (N,) or (N, k), of whatever type and unit the source has.
        height: rows of an organised cloud, stored row by row; 1: not organised.
        name: the source, for messages.
        fired: whether the points are in the order in which the sensor's beams swept, one beam after the other (KITTI).
        left_out: names of what the source holds and no column can (descriptors, Python objects).
    """

    values: dict[str, NDArray[np.generic]]
    height: int = 1
    name: str = "cloud"
    fired: bool = False
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True)
class Role:
    """What a column is.

    Attributes:
        column: its name, as recorded.
        unit: SI units per unit of its values, if the name states it: 1e-3 for `X (mm)`; else None.
    """

    column: str
    unit: float | None


KNOWN: Mapping[str, tuple[str, ...]] = {
    "xyz": ("xyz", "points", "pts", "point", "positions", "position", "coordinates", "coords", "vertices", "cloud",
            "pointcloud", "pc", "pcd", "lidar"),
    "x": ("x", "pointsxyz0", "points0", "pointsx", "xyz0", "pointx", "posx", "positionx", "coordx", "xcoord",
          "xcoordinate", "cartesianx", "px"),
    "y": ("y", "pointsxyz1", "points1", "pointsy", "xyz1", "pointy", "posy", "positiony", "coordy", "ycoord",
          "ycoordinate", "cartesiany", "py"),
    "z": ("z", "pointsxyz2", "points2", "pointsz", "xyz2", "pointz", "posz", "positionz", "coordz", "zcoord",
          "zcoordinate", "cartesianz", "pz"),
    "ring": ("ring", "ringid", "ringindex", "ringnumber", "rings", "channel", "channelid", "chan", "line", "lineid",
             "lineindex", "laserid", "laser", "laserindex", "lasernumber", "layer", "layerid", "beam", "beamid",
             "beamindex", "scanline", "row", "rowindex"),
    "intensity": ("intensity", "intensities", "reflectivity", "remission", "reflectance", "signal", "i"),
    "time": ("adjustedtime", "t", "time", "times", "timestamp", "timestamps", "timeoffset", "offsettime",
             "pointtimeoffset", "pointtime", "reltime", "relativetime", "deltatime", "deltat", "dt", "ts", "stamp",
             "gpstime"),
    "tag": ("tag",),
}  # fmt: skip
"""Names of columns for each role, as `plain` returns them; if a cloud has several, the first in the row counts."""

_LENGTHS = {"m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0, "cm": 1e-2, "mm": 1e-3,
            "millimeters": 1e-3, "millimetres": 1e-3, "in": 0.0254, "ft": 0.3048, "feet": 0.3048}  # fmt: skip
_TIMES = {"s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3,
          "milliseconds": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "usec": 1e-6, "microseconds": 1e-6, "ns": 1e-9,
          "nsec": 1e-9, "nanoseconds": 1e-9}  # fmt: skip
_BRACKETED = re.compile(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*\Z")
_ENDING = re.compile(r"(.+)_([a-z]{1,4})(_xyz:\d)?\Z", re.IGNORECASE)
_UNITS_OF_MAKERS = {"adjustedtime": 1e-6}
"""Units that a name implies without stating them: VeloView's microseconds."""


def plain(name: str) -> str:
    """Return a name in lower case, without quotes, separators and CloudCompare's prefix."""
    return re.sub(r"[^a-z0-9]", "", name.lower().removeprefix("scalar_").removeprefix("scalar field"))


def roles(names: Iterable[str]) -> dict[str, Role]:
    """Return the columns whose role is known, by the roles in `KNOWN`.

    Raises:
        InputError: a length in a unit that is not known.
    """
    candidates: dict[str, Role] = {}
    for name in names:
        word, unit = _parsed(name)
        candidates.setdefault(word, Role(name, unit))
    found = {
        role: next((candidates[word] for word in words if word in candidates), None) for role, words in KNOWN.items()
    }
    return {role: known for role, known in found.items() if known is not None}


@cache
def _words() -> frozenset[str]:
    return frozenset(word for words in KNOWN.values() for word in words)


def _parsed(name: str) -> tuple[str, float | None]:
    """Return a column's plain name, and its unit in SI units if stated: `X (mm)`, `time_us`, `points_m_XYZ:0`."""
    stripped = name.strip().strip('"').strip()
    for pattern in (_BRACKETED, _ENDING):
        if found := pattern.match(stripped):
            word, unit = plain(found[1] + (found[3] or "" if pattern is _ENDING else "")), found[2].lower()
            if word not in _words():
                continue
            lengths = word in KNOWN["x"] + KNOWN["y"] + KNOWN["z"] + KNOWN["xyz"]
            units = _LENGTHS if lengths else _TIMES if word in KNOWN["time"] else {}
            if unit in units:
                return word, units[unit]
            if pattern is _BRACKETED:
                if lengths and unit:
                    raise InputError(f"column '{name}': unit '{found[2]}'; expected one of: {', '.join(_LENGTHS)}")
                return word, None
    word = plain(stripped)
    return word, _UNITS_OF_MAKERS.get(word)
