"""Motion-capture files: which reader a file needs, told by its ending, or by the text in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from optshape_graph.errors import InputError
from optshape_graph.io.mocap.c3d import read_c3d
from optshape_graph.io.mocap.motive import read_motive_csv
from optshape_graph.io.mocap.qualisys import read_qualisys_mat, read_qualisys_tsv
from optshape_graph.io.mocap.recording import MocapRecording
from optshape_graph.io.mocap.tables import read_text
from optshape_graph.io.mocap.trc import read_trc
from optshape_graph.io.mocap.vicon import read_vicon_csv

Reader = Callable[[Path], MocapRecording]

_ENDINGS: dict[str, Reader | None] = {
    ".c3d": read_c3d, ".mat": read_qualisys_mat, ".tsv": read_qualisys_tsv, ".csv": None, ".txt": None,
    ".trc": read_trc,
}  # fmt: skip
"""Readers by the file's ending; None: the text in it tells."""

_TEXTS: dict[str, Reader] = {
    "qualisys": read_qualisys_tsv, "motive": read_motive_csv, "trc": read_trc, "vicon": read_vicon_csv,
}  # fmt: skip
"""Readers of text, by what `form_of` says."""


def read_mocap(path: str | Path) -> MocapRecording:
    """Read what a motion-capture system exported, whatever the format.

    Raises:
        InputError: none of the formats, or damaged.
        MissingExtraError: the library that reads C3D or MAT is absent.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in _ENDINGS:
        raise InputError(f"{path}: motion capture is read from {', '.join(_ENDINGS)} files")
    reader = _ENDINGS[ending] or _TEXTS.get(form_of(read_text(path)) or "")
    if reader is None:
        raise InputError(
            f"{path}: neither Motive's CSV (it begins with 'Format Version') nor Vicon's (it has a line "
            "'Trajectories') nor Qualisys' TSV (it begins with 'NO_OF_FRAMES')"
        )
    return reader(path)


def form_of(text: str) -> str | None:
    """Return which export of motion capture a text is: "qualisys", "motive", "trc" or "vicon"; None: none of them."""
    start = text[:4096].lstrip("\ufeff").lstrip()
    for beginning, form in (("NO_OF_", "qualisys"), ("Format Version", "motive"), ("PathFileType", "trc")):
        if start.startswith(beginning):
            return form
    if "Trajectories" in text and any(line.strip(' ,"\t;') == "Trajectories" for line in text.splitlines()):
        return "vicon"
    return None
