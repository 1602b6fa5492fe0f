"""C3D files, of whatever vendor."""

from __future__ import annotations

from pathlib import Path

from optshape_graph.io.mocap.binary import read_binary
from optshape_graph.io.mocap.recording import MocapRecording


def read_c3d(path: str | Path) -> MocapRecording:
    """Read a C3D file. Its parameters state units, rate and labels; a gap has a negative residual.

    What a model computed (POINT:ANGLES, FORCES, ...) is not read as a marker. Frames count from the file's first
    frame, as in the capture that the file was cut out of.

    Raises:
        InputError: not such a file, or damaged.
        MissingExtraError: the library that reads it is absent.
    """
    return read_binary("c3d", Path(path))
