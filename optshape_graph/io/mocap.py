"""Motion capture as the vendors export it: Qualisys TSV and MAT, C3D, Motive CSV, Vicon CSV, TRC.

Each is read with its own units, rate and way of writing a gap, into the same thing in metres.
"""

from __future__ import annotations

import csv
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.io._isolated import read_isolated
from optshape_graph.io.files import read_bytes

METRES = {
    "m": 1.0, "meters": 1.0, "metres": 1.0, "cm": 1e-2, "centimeters": 1e-2, "centimetres": 1e-2,
    "mm": 1e-3, "millimeters": 1e-3, "millimetres": 1e-3, "in": 0.0254, "inches": 0.0254, "ft": 0.3048, "feet": 0.3048,
}  # fmt: skip
"""Length units, as the vendors spell them."""

LARGEST_BAD_SHARE = 0.1
"""Share of frames that may be out of order; they are left out and counted."""

_LOG = logging.getLogger(__name__)

Rows = list[list[str]]

OUTPUTS = "output of a model, no marker"
UNLABELLED = "marker without a label"
REPEATED = "marker of a name that is there already"
LATE = "frame no later than the one before"
"""Why a part of a file is passed over."""


@dataclass(frozen=True, eq=False, repr=False)
class MocapRecording(Value):
    """Positions of markers over time.

    Attributes:
        times: (F,) seconds since the capture began, increasing; of the capture system's own clock.
        markers: M names, all different.
        positions: (F, M, 3) metres, motion-capture frame; NaN where a marker was not seen.
        rate: frames per second.
        name: where it came from, for messages.
        passed_over: number of markers and frames in the file that were not read, by reason.

    Raises:
        InputError: shapes that do not fit, names that repeat, times that do not increase, infinite positions.
    """

    times: Floats
    markers: tuple[str, ...]
    positions: Floats
    rate: float
    name: str = "motion capture"
    passed_over: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        times, positions = frozen(self.times), frozen(self.positions)
        if positions.shape != (len(times), len(self.markers), 3):
            raise InputError(
                f"{self.name}: {len(times)} frames and {len(self.markers)} markers, "
                f"but positions of shape {positions.shape}"
            )
        if not len(times) or not self.markers:
            raise InputError(f"{self.name}: {len(times)} frames of {len(self.markers)} markers: nothing was captured")
        if repeated := [marker for marker, times in Counter(self.markers).items() if times > 1]:
            raise InputError(f"{self.name}: several markers are called {min(repeated)!r}")
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise InputError(f"{self.name}: rate {self.rate} Hz is not a positive number")
        if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError(f"{self.name}: times of frames do not increase")
        gaps = np.isnan(positions).any(axis=2)
        if np.isinf(positions).any():
            raise InputError(f"{self.name}: a position is infinite")
        positions = np.where(gaps[:, :, None], np.nan, positions)
        positions.setflags(write=False)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "positions", positions)

    @property
    def seen(self) -> np.ndarray:
        """(F, M) whether a marker was seen in a frame."""
        return np.isfinite(self.positions[:, :, 0])

    def select(self, markers: Sequence[str]) -> MocapRecording:
        """Return the recording of some markers.

        Raises:
            InputError: one of them is not there.
        """
        column = {marker: k for k, marker in enumerate(self.markers)}
        if missing := [marker for marker in markers if marker not in column]:
            raise InputError(f"{self.name}: no marker {missing[0]!r}; it has {', '.join(self.markers)}")
        columns = [column[marker] for marker in markers]
        return replace(self, markers=tuple(markers), positions=self.positions[:, columns])

    def at(self, times: Floats) -> Floats:
        """(N, M, 3) positions, metres, at other times (N,), seconds, between the frames on either side; NaN at gaps.

        Two frames further apart than two and a half periods are a gap of all markers.
        """
        wanted = np.asarray(times, dtype=float)
        if len(self.times) == 1:
            exact = wanted == self.times[0]
            return np.where(exact[:, None, None], self.positions[0], np.nan)
        after = np.searchsorted(self.times, wanted).clip(1, len(self.times) - 1)
        t0, t1 = self.times[after - 1], self.times[after]
        inside = (wanted >= t0) & (wanted <= t1) & (t1 - t0 <= 2.5 / self.rate)
        w = ((wanted - t0) / (t1 - t0))[:, None, None]
        # On a frame itself the other one does not count, so that a gap beside it does no harm.
        blend = np.where(w == 0, self.positions[after - 1], np.where(w == 1, self.positions[after],
                         (1 - w) * self.positions[after - 1] + w * self.positions[after]))  # fmt: skip
        return np.where(inside[:, None, None], blend, np.nan)


def read_mocap(path: str | Path) -> MocapRecording:
    """Read what a motion-capture system exported; the format is told by suffix and content.

    Raises:
        InputError: none of the formats, or damaged.
    """
    path = Path(path)
    readers: dict[str, Callable[[Path], MocapRecording]] = {
        ".c3d": read_c3d, ".mat": read_qualisys_mat, ".tsv": read_qualisys_tsv, ".csv": _read_csv, ".txt": _read_csv,
        ".trc": read_trc,
    }  # fmt: skip
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: motion capture is read from {', '.join(readers)} files")
    return readers[path.suffix.lower()](path)


def _read_csv(path: Path) -> MocapRecording:
    first = _text(path)[:4096].lstrip()
    if first.startswith("NO_OF_"):
        return read_qualisys_tsv(path)
    if first.startswith("Format Version"):
        return read_motive_csv(path)
    if first.startswith("PathFileType"):
        return read_trc(path)
    if any(line.strip(' ,"\t;') == "Trajectories" for line in _text(path).splitlines()):
        return read_vicon_csv(path)
    raise InputError(
        f"{path}: neither Motive's CSV (it begins with 'Format Version') nor Vicon's (it has a line 'Trajectories') "
        "nor Qualisys' TSV (it begins with 'NO_OF_FRAMES')"
    )


def read_qualisys_tsv(path: str | Path) -> MocapRecording:
    """Read a 3D export of Qualisys Track Manager: millimetres; a gap is three zeros, or empty, or a word.

    Raises:
        InputError: not such a file, or damaged.
    """
    path = Path(path)
    rows = [row for row in _table(path, "\t") if row]
    names = next((k for k, row in enumerate(rows) if row[0].upper() == "MARKER_NAMES"), None)
    if names is None:
        raise InputError(f"{path}: expected a line 'MARKER_NAMES', as Qualisys Track Manager writes it")
    header = {row[0].upper(): [cell for cell in row[1:] if cell] or ["(none)"] for row in rows[: names + 1]}
    rows = rows[names + 1 :]
    if header.get("DATA_INCLUDED", ["3D"])[0].upper() != "3D":
        raise InputError(f"{path}: DATA_INCLUDED is {header['DATA_INCLUDED'][0]}; export 3D data")
    markers, rate = header["MARKER_NAMES"], _header_number(path, header, "FREQUENCY")
    if rows and rows[0][0].upper() == "TRAJECTORY_TYPES":
        rows.pop(0)
    leading = 2 if rows and len(rows[0]) >= 3 * len(markers) + 2 else 0  # frame and time, which are optional
    if rows and (rows[0][0] == "Frame" or rows[0][0].endswith(" X")):  # so is the row that names the columns
        leading = sum(cell in ("Frame", "Time") for cell in rows[0][:2])
        rows.pop(0)
    positions = _positions(path, rows, range(leading, leading + 3 * len(markers)), METRES["mm"])
    positions[(positions == 0).all(axis=2)] = np.nan
    times = _column(path, rows, 1) if leading == 2 else _times(path, len(rows), rate)
    return _recording(path, times, markers, positions, rate)


def read_qualisys_mat(path: str | Path) -> MocapRecording:
    """Read a MATLAB export of Qualisys Track Manager (format 5, not 7.3): millimetres; a gap is NaN.

    Raises:
        InputError: not such a file, or damaged.
    """
    return _read_binary("mat", Path(path))


def read_c3d(path: str | Path) -> MocapRecording:
    """Read a C3D file: units, rate and labels are its parameters; a gap has a negative residual.

    What a model computed (POINT:ANGLES, FORCES, ...) is no marker. Frames count from the file's first frame, as in the
    capture that it was cut out of.

    Raises:
        InputError: not such a file, or damaged.
    """
    return _read_binary("c3d", Path(path))


def _read_binary(form: str, path: Path) -> MocapRecording:
    read_bytes(path)  # missing, unreadable, too large
    content = read_isolated(form, path)
    positions, labels, rate = content["positions"], content["labels"], float(content["rate"])
    if len(labels) < positions.shape[1]:
        raise InputError(f"{path}: {positions.shape[1]} markers but {len(labels)} labels")
    markers = [str(label) for label in labels[: positions.shape[1]]]
    passed_over = {OUTPUTS: len(content.get("outputs", ()))}
    scale = _metres(path, str(content["unit"]))
    times = _times(path, len(positions), rate) + int(content.get("first_frame", 0)) / rate
    return _recording(path, times, markers, positions * scale, rate, passed_over)


def read_motive_csv(path: str | Path) -> MocapRecording:
    """Read a CSV export of OptiTrack Motive: units in its first line; a gap is empty.

    Where a marker was exported twice, measured and as its rigid body's model has it, the measured one is taken.

    Raises:
        InputError: not such a file, or damaged.
    """
    path = Path(path)
    motive = _motive(path)
    columns: list[tuple[str, int]] = []
    for wanted in ("Marker", "Rigid Body Marker"):
        found = [(name, k) for kind, name, k, what in motive.columns if kind == wanted and what == "Position"]
        known = {name for name, _ in columns}
        columns += [(name, k) for name, k in found if name not in known]
    if not columns:
        bodies = ", ".join(dict.fromkeys(name for kind, name, _, _ in motive.columns if kind == "Rigid Body"))
        raise InputError(
            f"{path}: no markers in it, but rigid bodies: {bodies}. As motion capture of a target, markers are needed "
            "(export them too); as the sensor's trajectory it is read (--odometry)"
            if bodies
            else f"{path}: no markers and no rigid bodies in it"
        )
    labelled = [(name, k) for name, k in columns if not name.lower().startswith("unlabeled")]
    passed_over = {UNLABELLED: len(columns) - len(labelled)} if labelled else {}
    columns = labelled or columns
    axes = [k + axis for _, k in columns for axis in range(3)]
    positions = _positions(path, motive.frames, axes, motive.scale)
    return _recording(path, _column(path, motive.frames, 1), [name for name, _ in columns], positions, motive.rate,
                      passed_over)  # fmt: skip


def read_motive_bodies(path: Path) -> tuple[Floats, dict[str, Floats], str]:
    """Read the rigid bodies of a CSV export of OptiTrack Motive.

    Returns:
        (F,) seconds since the capture began; by name of a body its positions, metres, and quaternions, x y z w, as
        (F, 7), NaN where it was not seen; and the file's name for messages.

    Raises:
        InputError: not such a file, damaged, or with rotations that are no quaternions.
    """
    motive = _motive(path)
    places = {(name, what): k for kind, name, k, what in motive.columns if kind == "Rigid Body"}
    bodies = {}
    for name, what in places:
        if what == "Position" and (name, "Rotation") in places:
            k, q = places[name, "Position"], places[name, "Rotation"]
            position = _positions(path, motive.frames, range(k, k + 3), motive.scale)[:, 0]
            turned = [[_number(row[q + i]) if q + i < len(row) else np.nan for i in range(4)] for row in motive.frames]
            bodies[name] = np.column_stack([position, np.array(turned, dtype=float).reshape(-1, 4)])
    if places and not bodies:
        raise InputError(f"{path}: rotations of rigid bodies as angles; export them as quaternions")
    return _column(path, motive.frames, 1), bodies, str(path)


@dataclass(frozen=True)
class _Motive:
    """An export of Motive: of each block of columns its type, name, first column and property; the lines of frames."""

    columns: list[tuple[str, str, int, str]]
    frames: Rows
    rate: float
    scale: float


def _motive(path: Path) -> _Motive:
    rows = [row for row in _table(path, ",") if any(row)]
    pairs = iter(rows[0])
    header = {key: [value] for key, value in zip(pairs, pairs, strict=False)}
    start = next((k for k, row in enumerate(rows) if row[0] == "Frame"), None)
    types = next((row for row in rows[:start] if len(row) > 1 and row[1] == "Type"), None)
    names = next((row for row in rows[:start] if len(row) > 1 and row[1] == "Name"), None)
    if start is None or types is None or names is None:
        raise InputError(f"{path}: expected header rows 'Type', 'Name' and 'Frame', as Motive writes them")
    kinds, axes = rows[start - 1], rows[start]
    blocks = {"Position": ["X", "Y", "Z"], "Rotation": ["X", "Y", "Z", "W"]}
    columns = [
        (types[k], names[k], k, what)
        for k in range(2, min(len(axes), len(types), len(names), len(kinds)))
        for what, letters in blocks.items()
        if kinds[k : k + len(letters)] == [what] * len(letters) and axes[k : k + len(letters)] == letters
    ]
    scale = _metres(path, header.get("Length Units", ["(none)"])[0])
    rate = _header_number(path, header, "Export Frame Rate" if "Export Frame Rate" in header else "Capture Frame Rate")
    return _Motive(columns, rows[start + 1 :], rate, scale)


def read_trc(path: str | Path) -> MocapRecording:
    """Read a TRC file (Motion Analysis, OpenSim): units and rate in its third line; a gap is empty.

    Raises:
        InputError: not such a file, or damaged.
    """
    path = Path(path)
    rows = _table(path, "\t")
    names = next((k for k, row in enumerate(rows) if row and row[0].lower().startswith("frame")), None)
    if names is None or names < 2:
        raise InputError(f"{path}: expected the lines of a TRC file: its header, and 'Frame#', 'Time' and the markers")
    header = {key.lower(): [value] for key, value in zip(rows[names - 2], rows[names - 1], strict=False) if key}
    columns = [(name, k) for k, name in enumerate(rows[names]) if k > 1 and name]
    frames = [row for row in rows[names + 2 :] if row and _is_number(row[0])]
    rate = _header_number(path, header, "datarate")
    scale = _metres(path, header.get("units", ["(none)"])[0])
    positions = _positions(path, frames, [k + axis for _, k in columns for axis in range(3)], scale)
    return _recording(path, _column(path, frames, 1), [name for name, _ in columns], positions, rate)


def read_vicon_csv(path: str | Path) -> MocapRecording:
    """Read the trajectories of a CSV export of Vicon Nexus: a gap is empty; frame 1 is time 0.

    Raises:
        InputError: not such a file, or damaged.
    """
    path = Path(path)
    rows = _table(path, ",")
    begin = next((k for k, row in enumerate(rows) if row[:1] == ["Trajectories"]), None)
    if begin is None or len(rows) < begin + 5 or not rows[begin + 1] or not _is_number(rows[begin + 1][0]):
        raise InputError(f"{path}: expected a section 'Trajectories': rate, names, axes, units and frames")
    rate = float(rows[begin + 1][0])
    names, axes, units = rows[begin + 2], rows[begin + 3], rows[begin + 4]
    columns = [(names[k], k) for k in range(2, min(len(names), len(axes) - 2))
               if names[k] and axes[k : k + 3] == ["X", "Y", "Z"]]  # fmt: skip
    frames = rows[begin + 5 :]
    frames = frames[: next((k for k, row in enumerate(frames) if not any(row)), len(frames))]
    scale = _metres(path, units[2] if len(units) > 2 else "(none)")
    positions = _positions(path, frames, [k + axis for _, k in columns for axis in range(3)], scale)
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"{path}: rate {rate} Hz is not a positive number")
    times = (_column(path, frames, 0) - 1) / rate
    return _recording(path, times, [name for name, _ in columns], positions, rate)


def _recording(
    path: Path,
    times: Floats,
    markers: Sequence[str],
    positions: Floats,
    rate: float,
    passed_over: Mapping[str, int] | None = None,
) -> MocapRecording:
    """The recording without what is there twice: of markers of one name the first, of frames of one time the first."""
    counts = Counter(passed_over or {})
    first = {name: k for k, name in reversed(list(enumerate(markers)))}
    if len(first) < len(markers):
        counts[REPEATED] += len(markers) - len(first)
        repeated = sorted({name for k, name in enumerate(markers) if first[name] != k})
        _LOG.warning("%s: several markers are called %s; the first of each is read", path, ", ".join(repeated))
    latest = np.maximum.accumulate(times) if len(times) else times
    later = np.ones(len(times), dtype=bool)
    later[1:] = times[1:] > latest[:-1]
    if not later.all() and later.mean() > 1 - LARGEST_BAD_SHARE:
        _LOG.warning(
            "%s: %d of %d frames are no later than the one before and left out", path, (~later).sum(), len(later)
        )
        counts[LATE] += int((~later).sum())
        times, positions = times[later], positions[later]
    kept = sorted(first.values())
    names = tuple(markers[k] for k in kept)
    return MocapRecording(times, names, positions[:, kept], rate, str(path), +counts)


def _text(path: Path) -> str:
    """Return the text of an export: UTF-8 or, from a Windows program, some code page in its names."""
    return read_bytes(path).decode("utf-8-sig", errors="replace")


def _table(path: Path, delimiter: str) -> Rows:
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(_text(path).splitlines(), delimiter=delimiter)]
    except csv.Error as error:
        raise InputError(f"{path}: {error}") from error
    if not any(any(row) for row in rows):
        raise InputError(f"{path}: the file is empty")
    return rows


def _positions(path: Path, rows: Rows, columns: Sequence[int], scale: float) -> Floats:
    """(F, M, 3) metres of the cells of 3 M columns."""
    values = [[_number(row[k]) if k < len(row) else np.nan for k in columns] for row in rows]
    return np.array(values, dtype=float).reshape(len(rows), len(columns) // 3, 3) * scale


def _column(path: Path, rows: Rows, column: int) -> Floats:
    values = np.array([_number(row[column]) if column < len(row) else np.nan for row in rows])
    if np.isnan(values).any():
        k = int(np.isnan(values).argmax())
        raise InputError(f"{path}: frame {k} has no number in column {column + 1}, found {rows[k][: column + 1]}")
    return values


def _times(path: Path, frames: int, rate: float) -> Floats:
    """(F,) seconds of frames at a rate, from 0 on."""
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"{path}: rate {rate} Hz is not a positive number")
    return np.arange(frames) / rate


def _number(cell: str) -> float:
    """Return the number in a cell, NaN where there is none: an empty cell or a word is how a gap is written."""
    try:
        return float(cell)
    except ValueError:
        return np.nan


def _is_number(cell: str) -> bool:
    return not np.isnan(_number(cell))


def _header_number(path: Path, header: dict[str, list[str]], key: str) -> float:
    value = (header.get(key) or ["(none)"])[0]
    if not _is_number(value):
        raise InputError(f"{path}: expected a number as {key} in the header, found {value}")
    return float(value)


def _metres(path: Path, unit: str) -> float:
    if unit.strip().lower() not in METRES:
        raise InputError(f"{path}: unit of length '{unit}'; expected one of {', '.join(METRES)}")
    return METRES[unit.strip().lower()]
