"""Files shipped with the package: targets and sensors that go by a name instead of a path, and a session."""

from __future__ import annotations

import os
from pathlib import Path

from optshape_graph.errors import InputError
from optshape_graph.io.files import is_file

_DATA = Path(__file__).resolve().parents[1] / "data"


RENAMED = {
    "target": {"optimal": "score-optimal", "optimal3": "score-optimal3", "optimal5": "score-optimal5"},
    "sensor": {},
}
"""Former names that files may use. `optimal` was misleading: it maximises the paper's score, not the pose's
accuracy."""


def builtin_names(kind: str) -> list[str]:
    """Return the names of the built-in files of a kind, "target" or "sensor", in order."""
    return sorted(path.stem for path in (_DATA / f"{kind}s").glob("*.yaml"))


def demo_folder() -> Path:
    """Return the folder of the bundled session: scans of a target with markers, `session.yaml`, `truth.json`."""
    return _DATA / "demo"


def find(kind: str, name: str, folder: Path | None = None) -> Path:
    """Return the file that a built-in name or a path stands for; a relative path starts at `folder`.

    A built-in name wins over a file of exactly that name: `./square` is the file, `square` the built-in.

    Raises:
        InputError: neither a built-in name nor a file.
    """
    names = builtin_names(kind)
    name = RENAMED[kind].get(name, name)
    if name in names:
        return _DATA / f"{kind}s" / f"{name}.yaml"
    path = Path(name) if folder is None else folder / name
    if is_file(path):
        return path
    if name and os.path.isdir(path):
        raise InputError(f"{path}: a folder; expected the file of a {kind}, or a built-in one: {', '.join(names)}")
    raise InputError(f"{path}: no such file, and the built-in {kind}s are: {', '.join(names)}")
