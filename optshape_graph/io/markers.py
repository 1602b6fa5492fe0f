"""Markers of a session: a CSV file with the columns frame, marker, x, y, z, or a vendor's export (`io.mocap`)."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.io.files import read_text
from optshape_graph.io.mocap import UNLABELLED, MocapRecording, form_of, read_mocap
from optshape_graph.target import LARGEST_EXTENT_M

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""Metres per unit of length."""

_COLUMNS = ("frame", "marker", "x", "y", "z")
_SMALLEST_EXTENT_M = 0.01


@dataclass(frozen=True, eq=False, repr=False)
class Markers(Value):
    """Marker positions over frames.

    Attributes:
        frames: for each frame, the position (3,) of every marker, metres, motion-capture frame; NaN where a marker was
            not seen. Every frame has every marker.
        names: the markers, in the order in which they first occur.
        passed_over: number of markers, frames and rows in the file that were not read, by reason.
    """

    frames: dict[int, dict[str, Floats]]
    names: tuple[str, ...]
    passed_over: Mapping[str, int] = field(default_factory=dict)


def states_its_units(path: str | Path) -> bool:
    """Return whether a file is a vendor's export, which states its unit of length, and not the CSV of this package."""
    if Path(path).suffix.lower() != ".csv":
        return True
    return form_of(read_text(path)) is not None


def read_markers(path: str | Path, units: str = "m") -> Markers:
    """Read marker positions.

    A marker that was not seen is left out of its frame, or has empty or NaN coordinates. Rows without a marker's name
    are skipped.

    Args:
        path: a CSV file whose first line names the columns frame, marker, x, y, z, in any order and case; or an
            export that `read_mocap` reads, whose frames are counted from 0.
        units: of the coordinates: "m", "cm" or "mm"; ignored for an export, which states its own.

    Raises:
        InputError: not readable, other columns, a frame that is not an integer, a coordinate that is not a number, a
            marker twice in a frame or with one or two coordinates only, or markers as far apart as in wrong units.
    """
    if states_its_units(path):
        return _of_recording(read_mocap(path))
    if units not in UNITS:
        raise InputError(f"{path}: units '{units}', expected one of: {', '.join(UNITS)}")
    reader = csv.reader(io.StringIO(read_text(path), newline=""))
    try:
        lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(map(str.strip, row))]
    except csv.Error as error:
        raise InputError(f"{path}:{reader.line_num}: not CSV ({error})") from error
    header = [name.lower() for name in lines[0][1]] if lines else []
    if sorted(header) != sorted(_COLUMNS):
        found = ",".join(header)[:80]
        raise InputError(f"{path}: expected a first line with the columns {','.join(_COLUMNS)}, found '{found}'")
    seen: dict[int, dict[str, Floats]] = {}
    passed_over: Counter[str] = Counter()
    for line, cells in lines[1:]:
        where = f"{path}:{line}"
        if len(cells) != len(header):
            raise InputError(f"{where}: expected {len(header)} values, found {len(cells)}")
        row = dict(zip(header, cells, strict=True))
        frame, marker = _frame(where, row["frame"]), row["marker"]
        if not marker:
            passed_over[UNLABELLED] += 1
            continue
        if marker in seen.setdefault(frame, {}):
            raise InputError(f"{where}: marker '{marker}' is given twice in frame {frame}")
        seen[frame][marker] = frozen(np.array([_coordinate(where, row[axis]) for axis in "xyz"]) * UNITS[units])
        if 0 < np.isnan(seen[frame][marker]).sum() < 3:
            raise InputError(f"{where}: marker '{marker}' has some coordinates only; expected all three or none")
    if not seen:
        raise InputError(f"{path}: no markers after the first line")
    names = tuple(dict.fromkeys(name for markers in seen.values() for name in markers))
    missing = frozen(np.full(3, np.nan))
    frames = {frame: {name: markers.get(name, missing) for name in names} for frame, markers in seen.items()}
    _check_extent(path, frames, units)
    return Markers(frames, names, passed_over)


def _of_recording(recording: MocapRecording) -> Markers:
    frames = {
        number: dict(zip(recording.markers, positions, strict=True))
        for number, positions in enumerate(recording.positions)
    }
    return Markers(frames, recording.markers, recording.passed_over)


def _frame(where: str, text: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise InputError(f"{where}: expected a frame number, found '{text[:40]}'") from error


def _coordinate(where: str, text: str) -> float:
    try:
        value = float(text) if text else np.nan
    except ValueError as error:
        raise InputError(f"{where}: expected a coordinate, found '{text[:40]}'") from error
    if np.isinf(value):
        raise InputError(f"{where}: expected a finite coordinate, found '{text}'")
    return value


def _check_extent(path: str | Path, frames: dict[int, dict[str, Floats]], units: str) -> None:
    """Refuse markers whose distances show that the unit is wrong."""
    for frame, markers in frames.items():
        positions = np.array(list(markers.values()))
        positions = positions[~np.isnan(positions).any(axis=1)]
        if len(positions) < 2:
            continue
        extent = float(np.ptp(positions, axis=0).max())
        if extent > LARGEST_EXTENT_M or extent < _SMALLEST_EXTENT_M:
            raise InputError(
                f"{path}: the markers of frame {frame} span {extent:g} m, read in '{units}'; expected "
                f"{_SMALLEST_EXTENT_M:g} to {LARGEST_EXTENT_M:g} m (is the unit right?)"
            )
