"""Execute every notebook, or those named, and store them with their outputs: `python -m tests.notebooks [NAME...]`."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import nbformat

from tests.notebooks.executing import NOTEBOOKS, executed

METADATA = ("kernelspec", "language_info")


def store(path: Path) -> None:
    """Write a notebook over itself, as it comes out, without what differs from machine to machine."""
    before = nbformat.read(path, as_version=4).metadata
    with tempfile.TemporaryDirectory() as folder:
        notebook = executed(path, Path(folder))
    notebook.metadata = nbformat.from_dict({key: before[key] for key in METADATA})
    for cell in notebook.cells:
        cell.metadata = nbformat.from_dict({})
        for output in cell.get("outputs", []):
            if "metadata" in output:
                output.metadata = nbformat.from_dict({})
    nbformat.write(notebook, path)
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    wanted = sys.argv[1:]
    for path in NOTEBOOKS:
        if not wanted or any(name in path.name for name in wanted):
            store(path)
