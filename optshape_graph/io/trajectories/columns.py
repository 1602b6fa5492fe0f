"""Columns of a trajectory's table: what their names say they hold, and in which units."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from optshape_graph.errors import InputError
from optshape_graph.io.mocap import METRES

_ORDER = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")

_NAMES: dict[str, tuple[str, ...]] = {
    "stamp": ("timestamp", "time", "stamp", "t", "ts", "sec", "seconds", "times", "timestampns", "timens", "nsec"),
    "x": ("x", "tx", "px", "prsrx", "posx", "positionx", "pos0", "translationx", "transx"),
    "y": ("y", "ty", "py", "prsry", "posy", "positiony", "pos1", "translationy", "transy"),
    "z": ("z", "tz", "pz", "prsrz", "posz", "positionz", "pos2", "translationz", "transz"),
    "qx": ("qx", "qrsx", "quatx", "orientationx", "rotx", "rotationx", "quaternionx", "orix"),
    "qy": ("qy", "qrsy", "quaty", "orientationy", "roty", "rotationy", "quaterniony", "oriy"),
    "qz": ("qz", "qrsz", "quatz", "orientationz", "rotz", "rotationz", "quaternionz", "oriz"),
    "qw": ("qw", "qrsw", "quatw", "orientationw", "rotw", "rotationw", "quaternionw", "oriw"),
    "roll": ("roll", "rollrad", "rolldeg", "rx"), "pitch": ("pitch", "pitchrad", "pitchdeg", "ry"),
    "yaw": ("yaw", "yawrad", "yawdeg", "rz", "heading"),
}  # fmt: skip
"""What a column holds, and the names that say so, in lower case and without separators."""

_SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0}
"""Seconds per unit of time."""


@dataclass(frozen=True)
class Layout:
    """Which words of a line are stamp, position and quaternion, and in which units.

    Attributes:
        words: places in the line of stamp, x, y, z, qx, qy, qz, qw.
        stamp_unit: in seconds; None: each stamp's size tells.
        length_unit: in metres.
        width: words that a line has at least; exactly, where no names are given.
        named: whether a line of names gave this layout.
    """

    words: tuple[int, ...] = tuple(range(8))
    stamp_unit: float | None = None
    length_unit: float = 1.0
    width: int = 8
    named: bool = False


def attach_units(line: str) -> str:
    """Return a line whose units follow their names at once, in square brackets: `time[s]` where it has `time (s)`."""
    return re.sub(r"\s*[\[(]([^\])]*)[\])]", r"[\1]", line)


def names_in(line: str) -> list[str]:
    """Return the names in a line of names, each with its unit in square brackets, if any.

    Commas, semicolons or tabs separate names; in a line without them, blanks do.
    """
    line = attach_units(line.strip().lstrip("#%/ "))
    delimiter = next((d for d in ",;\t" if d in line), None)
    return line.split(delimiter)


def layout_of(path: Path, words: list[str]) -> Layout | None:
    """Return the layout that names of columns state; None: they do not name a trajectory's columns.

    Raises:
        InputError: angles where quaternions are expected, or a unit of length that is not known.
    """
    found: dict[str, tuple[int, str]] = {}
    for k, word in enumerate(words):
        name, _, unit = word.lower().partition("[")
        path_in_message = [part for part in re.split(r"[./]", name) if part]  # of ROS: field.pose.pose.position.x
        plain = re.sub(r"[^a-z0-9]", "", "".join(path_in_message[-2:]))
        role = next((role for role, names in _NAMES.items() if plain in names), None)
        if role is not None:
            found.setdefault(role, (k, unit.rstrip("]")))
    if {"stamp", "x", "y", "z"} <= found.keys() and not {"qx", "qy", "qz", "qw"} <= found.keys():
        if {"roll", "pitch", "yaw"} & found.keys():
            raise InputError(f"{path}: orientations as roll, pitch and yaw; expected quaternions, x y z w")
        return None
    if not set(_ORDER) <= found.keys():
        return None
    unit = found["stamp"][1]
    length = METRES.get(found["x"][1] or "m")
    if length is None:
        raise InputError(f"{path}: unit of length '{found['x'][1]}'; expected one of {', '.join(METRES)}")
    indices = tuple(found[role][0] for role in _ORDER)
    return Layout(indices, _SECONDS.get(unit), length, max(indices) + 1, True)


def check_width(path: Path, rows: list[tuple[int, list[str]]], layout: Layout, commas: bool) -> None:
    """Refuse KITTI's poses, and stamps in nanoseconds without names: there w may be first or last in the quaternion.

    Args:
        path: the file, for messages.
        rows: line number and words of each line of numbers.
        layout: of the lines.
        commas: whether commas separate the words.

    Raises:
        InputError: one of the two.
    """
    if not rows or layout.named:
        return
    number, words = rows[0]
    if len(words) == 12:
        raise InputError(f"{path}:{number}: twelve numbers a line are KITTI's poses, which have no stamps; expected "
                         "'stamp tx ty tz qx qy qz qw'")  # fmt: skip
    whole = re.fullmatch(r"\d{16,20}", words[0]) is not None
    if whole and commas and len(words) >= 8:
        raise InputError(
            f"{path}:{number}: stamps in nanoseconds, and no line of names that tells whether w is the first or "
            "the last of the quaternion; expected one, as '#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z'"
        )
