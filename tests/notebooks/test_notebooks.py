"""The notebooks run as they are, by this interpreter, in an empty folder; and are kept with their pictures."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("nbformat")
pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

import nbformat

from tests.notebooks.executing import NOTEBOOKS, executed, read

DRAWS = re.compile(r"^\s*(plot_\w+\(|plt\.show\(\))", re.MULTILINE)
LARGEST = 1_500_000
"""Bytes of a notebook with its pictures."""

each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def check_outputs(notebook: nbformat.NotebookNode) -> None:
    """Assert that no cell fails or warns, and that what draws has a picture."""
    for cell in notebook.cells:
        if cell.cell_type == "code":
            said = [o.text for o in cell.outputs if o.output_type == "stream" and o.name == "stderr"]
            assert not said, f"{cell.source}\nwarns: {said}"
            assert not [output for output in cell.outputs if output.output_type == "error"], cell.source
            if DRAWS.search(cell.source):
                assert any("image/png" in output.get("data", {}) for output in cell.outputs), (
                    f"no picture: {cell.source}"
                )


def test_there_are_seven() -> None:
    assert [path.name[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05", "06", "07"]


@each
def test_a_notebook_runs(path: Path, tmp_path: Path) -> None:
    check_outputs(executed(path, tmp_path))


@each
def test_a_notebook_is_stored_with_its_pictures_and_says_what_it_shows(path: Path) -> None:
    """`python -m tests.notebooks` stores them."""
    notebook = read(path)
    nbformat.validate(notebook)
    check_outputs(notebook)
    assert path.stat().st_size < LARGEST
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert notebook.cells[0].cell_type == "markdown"
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    for before, cell in zip(notebook.cells, notebook.cells[1:], strict=False):
        assert cell.metadata == {}
        if cell.cell_type == "code":
            if DRAWS.search(cell.source):
                assert before.cell_type == "markdown", f"nothing says what is shown: {cell.source}"
            said = [str(output.get("text", "")) + str(output.get("data", {})) for output in cell.outputs]
            assert not re.search(r"/(tmp|home|root|work)/", "".join(said)), f"a path of one machine: {cell.source}"


@each
def test_a_notebook_uses_what_is_public(path: Path) -> None:
    source = "\n".join(cell.source for cell in read(path).cells if cell.cell_type == "code")
    for line in re.findall(r"^\s*(?:from|import) .*$", source, re.MULTILINE):
        assert not re.search(r"\btests\b|\._|import _", line), line
