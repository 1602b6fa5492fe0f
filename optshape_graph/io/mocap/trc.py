"""TRC files (Motion Analysis, OpenSim)."""

from __future__ import annotations

from pathlib import Path

from optshape_graph.errors import InputError
from optshape_graph.io.mocap.recording import MocapRecording, make_recording
from optshape_graph.io.mocap.tables import column_of, header_number, is_number, positions_of, read_table
from optshape_graph.io.mocap.units import metres_per


def read_trc(path: str | Path) -> MocapRecording:
    """Read a TRC file (Motion Analysis, OpenSim). Its third line states units and rate; a gap is empty.

    Raises:
        InputError: not such a file, or damaged.
    """
    path = Path(path)
    rows = read_table(path, "\t")
    names = next((k for k, row in enumerate(rows) if row and row[0].lower().startswith("frame")), None)
    if names is None or names < 2:
        raise InputError(f"{path}: expected the lines of a TRC file: its header, and 'Frame#', 'Time' and the markers")
    header = {key.lower(): [value] for key, value in zip(rows[names - 2], rows[names - 1], strict=False) if key}
    columns = [(name, k) for k, name in enumerate(rows[names]) if k > 1 and name]
    frames = [row for row in rows[names + 2 :] if row and is_number(row[0])]
    rate = header_number(header, "datarate", path)
    metres = metres_per(header.get("units", ["(none)"])[0], path)
    positions = positions_of(frames, [k + axis for _, k in columns for axis in range(3)], metres)
    return make_recording(path, column_of(frames, 1, path), [name for name, _ in columns], positions, rate)
