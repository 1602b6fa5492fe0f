"""Exports of Qualisys Track Manager: TSV and MAT."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.mocap.binary import read_binary
from optshape_graph.io.mocap.recording import MocapRecording, make_recording
from optshape_graph.io.mocap.tables import column_of, header_number, positions_of, read_table
from optshape_graph.io.mocap.units import METRES, times_of


def read_qualisys_tsv(path: str | Path) -> MocapRecording:
    """Read a TSV of 3D data from Qualisys Track Manager. It is in millimetres; a gap is three zeros, empty, or a word.

    Raises:
        InputError: not such a file, or damaged.
    """
    path = Path(path)
    rows = [row for row in read_table(path, "\t") if row]
    names = next((k for k, row in enumerate(rows) if row[0].upper() == "MARKER_NAMES"), None)
    if names is None:
        raise InputError(f"{path}: expected a line 'MARKER_NAMES', as Qualisys Track Manager writes it")
    header = {row[0].upper(): [cell for cell in row[1:] if cell] or ["(none)"] for row in rows[: names + 1]}
    rows = rows[names + 1 :]
    if header.get("DATA_INCLUDED", ["3D"])[0].upper() != "3D":
        raise InputError(f"{path}: DATA_INCLUDED is {header['DATA_INCLUDED'][0]}; export 3D data")
    markers, rate = header["MARKER_NAMES"], header_number(header, "FREQUENCY", path)
    if rows and rows[0][0].upper() == "TRAJECTORY_TYPES":
        rows.pop(0)
    leading = 2 if rows and len(rows[0]) >= 3 * len(markers) + 2 else 0  # frame and time, which are optional
    if rows and (rows[0][0] == "Frame" or rows[0][0].endswith(" X")):  # so is the row that names the columns
        leading = sum(cell in ("Frame", "Time") for cell in rows[0][:2])
        rows.pop(0)
    positions = positions_of(rows, range(leading, leading + 3 * len(markers)), METRES["mm"])
    positions[(positions == 0).all(axis=2)] = np.nan
    times = column_of(rows, 1, path) if leading == 2 else times_of(np.arange(len(rows), dtype=float), rate, path)
    return make_recording(path, times, markers, positions, rate)


def read_qualisys_mat(path: str | Path) -> MocapRecording:
    """Read a MATLAB file from Qualisys Track Manager (format 5, not 7.3). It is in millimetres; a gap is NaN.

    Raises:
        InputError: not such a file, or damaged.
        MissingExtraError: SciPy's reader is absent.
    """
    return read_binary("mat", Path(path))
