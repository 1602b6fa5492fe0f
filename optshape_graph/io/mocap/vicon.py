"""CSV exports of Vicon Nexus."""

from __future__ import annotations

from pathlib import Path

from optshape_graph.errors import InputError
from optshape_graph.io.mocap.recording import MocapRecording, make_recording
from optshape_graph.io.mocap.tables import column_of, is_number, positions_of, read_table
from optshape_graph.io.mocap.units import metres_per, times_of


def read_vicon_csv(path: str | Path) -> MocapRecording:
    """Read the section of trajectories in a CSV export of Vicon Nexus. A gap is empty; frame 1 is at time 0.

    Raises:
        InputError: not such a file, or damaged.
    """
    path = Path(path)
    rows = read_table(path, ",")
    begin = next((k for k, row in enumerate(rows) if row[:1] == ["Trajectories"]), None)
    if begin is None or len(rows) < begin + 5 or not rows[begin + 1] or not is_number(rows[begin + 1][0]):
        raise InputError(f"{path}: expected a section 'Trajectories': rate, names, axes, units and frames")
    rate = float(rows[begin + 1][0])
    names, axes, units = rows[begin + 2], rows[begin + 3], rows[begin + 4]
    columns = [(names[k], k) for k in range(2, min(len(names), len(axes) - 2))
               if names[k] and axes[k : k + 3] == ["X", "Y", "Z"]]  # fmt: skip
    frames = rows[begin + 5 :]
    frames = frames[: next((k for k, row in enumerate(frames) if not any(row)), len(frames))]
    metres = metres_per(units[2] if len(units) > 2 else "(none)", path)
    positions = positions_of(frames, [k + axis for _, k in columns for axis in range(3)], metres)
    times = times_of(column_of(frames, 0, path) - 1, rate, path)
    return make_recording(path, times, [name for name, _ in columns], positions, rate)
