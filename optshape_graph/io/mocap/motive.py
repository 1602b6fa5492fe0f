"""CSV exports of OptiTrack Motive: markers and rigid bodies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.io.mocap.recording import UNLABELLED, MocapRecording, make_recording
from optshape_graph.io.mocap.tables import Rows, column_of, header_number, numbers_in, positions_of, read_table
from optshape_graph.io.mocap.units import metres_per


def read_motive_csv(path: str | Path) -> MocapRecording:
    """Read the markers in a CSV export of OptiTrack Motive. Its first line states the units; a gap is empty.

    A marker that was exported twice, as measured and as the model of its rigid body has it, is read as measured.

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
    positions = positions_of(motive.frames, axes, motive.metres)
    times, markers = column_of(motive.frames, 1, path), [name for name, _ in columns]
    return make_recording(path, times, markers, positions, motive.rate, passed_over)


def read_motive_bodies(path: Path) -> tuple[Floats, dict[str, Floats]]:
    """Read the rigid bodies in a CSV export of OptiTrack Motive.

    Returns:
        The times (F,), in seconds since the capture began; and for each body, by name, an array (F, 7) of its position,
        in metres, and its quaternion x y z w, NaN where it was not seen.

    Raises:
        InputError: not such a file, damaged, or with rotations that are no quaternions.
    """
    motive = _motive(path)
    places = {(name, what): k for kind, name, k, what in motive.columns if kind == "Rigid Body"}
    bodies = {}
    for name, what in places:
        if what == "Position" and (name, "Rotation") in places:
            k, q = places[name, "Position"], places[name, "Rotation"]
            position = positions_of(motive.frames, range(k, k + 3), motive.metres)[:, 0]
            bodies[name] = np.column_stack([position, numbers_in(motive.frames, range(q, q + 4))])
    if places and not bodies:
        raise InputError(f"{path}: rotations of rigid bodies as angles; export them as quaternions")
    return column_of(motive.frames, 1, path), bodies


@dataclass(frozen=True)
class _Motive:
    """An export of Motive.

    Attributes:
        columns: of each block of columns, its type ("Marker", ...), name, first column and property ("Position", ...).
        frames: the rows of the frames.
        rate: frames per second.
        metres: in its unit of length.
    """

    columns: list[tuple[str, str, int, str]]
    frames: Rows
    rate: float
    metres: float


def _motive(path: Path) -> _Motive:
    rows = [row for row in read_table(path, ",") if any(row)]
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
    metres = metres_per(header.get("Length Units", ["(none)"])[0], path)
    rate = header_number(header, "Export Frame Rate" if "Export Frame Rate" in header else "Capture Frame Rate", path)
    return _Motive(columns, rows[start + 1 :], rate, metres)
