"""Execute a notebook by this interpreter, in a folder of its own."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from unittest.mock import patch

import nbformat

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
TIMEOUT = 300
"""Seconds that a cell may take."""


def read(path: Path) -> nbformat.NotebookNode:
    """Read a notebook."""
    return nbformat.read(path, as_version=4)


def executed(path: Path, folder: Path) -> nbformat.NotebookNode:
    """Return a notebook with its outputs; `folder` is empty, and keeps what it writes."""
    from jupyter_client.kernelspec import KernelSpec
    from jupyter_client.manager import AsyncKernelManager
    from nbclient import NotebookClient

    class ThisInterpreter(AsyncKernelManager):
        """No kernel needs to be installed, and none that is can be taken by mistake."""

        @property
        def kernel_spec(self) -> KernelSpec:
            return KernelSpec(argv=[sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"])

    names = ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR")
    work = folder / "work"
    work.mkdir()
    notebook = read(path)
    environment = {"PYTHONPATH": str(FOLDER.parent), **{name: str(folder / name.lower()) for name in names}}
    with patch.dict(os.environ, environment):
        resources = {"metadata": {"path": str(work)}}
        NotebookClient(notebook, timeout=TIMEOUT, kernel_manager_class=ThisInterpreter, resources=resources).execute()
    return notebook
