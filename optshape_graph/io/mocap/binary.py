"""Binary motion-capture files, which native code reads in a process of its own (`io._isolated`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io._isolated import read_isolated
from optshape_graph.io.files import read_bytes
from optshape_graph.io.mocap.recording import OUTPUTS, MocapRecording, make_recording
from optshape_graph.io.mocap.units import metres_per, times_of


def read_binary(form: str, path: Path) -> MocapRecording:
    """Read a "c3d" or "mat" file.

    Raises:
        InputError: not such a file, or damaged.
        MissingExtraError: the library that reads it is absent.
    """
    read_bytes(path)  # missing, unreadable, too large
    content = read_isolated(form, path)
    positions, labels, rate = content["positions"], content["labels"], float(content["rate"])
    if len(labels) < positions.shape[1]:
        raise InputError(f"{path}: {positions.shape[1]} markers but {len(labels)} labels")
    markers = [str(label) for label in labels[: positions.shape[1]]]
    passed_over = {OUTPUTS: len(content.get("outputs", ()))}
    metres = metres_per(str(content["unit"]), path)
    times = times_of(np.arange(len(positions), dtype=float), rate, path) + int(content.get("first_frame", 0)) / rate
    return make_recording(path, times, markers, positions * metres, rate, passed_over)
