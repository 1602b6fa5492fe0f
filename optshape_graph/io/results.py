"""Results: printed in one line, shown in a notebook, turned into tables, saved and loaded."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from optshape_graph._arrays import Value
from optshape_graph.errors import InputError, missing_extra
from optshape_graph.io.documents import read_document, write_json
from optshape_graph.io.records import from_record, to_record
from optshape_graph.names import markup

if TYPE_CHECKING:
    import pandas

Row = dict[str, Any]

MOST_ROWS = 20
"""Rows that a notebook shows."""

RECORD = "record"
"""Key of a saved result under which `load` finds all of it."""


class Result(Value):
    """Base of the results of estimation, detection, calibration and mapping: frozen dataclasses.

    Attributes:
        FORM: kind of the file that it is saved in: `optshape/<FORM>/1`.
    """

    FORM: ClassVar[str]

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data, with the keys of its file."""
        raise NotImplementedError  # each kind of result has its own

    def rows(self) -> list[Row]:
        """Return the result as a table: one row for each scan, target, view or landmark."""
        raise NotImplementedError  # each kind of result has its own

    def to_dataframe(self) -> pandas.DataFrame:
        """Return `rows` as a data frame.

        Raises:
            MissingExtraError: pandas is absent.
        """
        return dataframe(self.rows())

    def save(self, path: str | Path) -> None:
        """Write the result as JSON: the same as the command writes, and all that `load` needs under `record`.

        Args:
            path: of the file; `optshape view` shows it.

        Raises:
            InputError: the file cannot be written.
        """
        write_json(path, self._document())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a result that `save` wrote: equal to what was saved.

        Args:
            path: of the file.

        Raises:
            InputError: another file, one without a record, or a record of another version.
        """
        root = read_document(path, cls.FORM)
        if RECORD not in root.value:
            root.fail(f"the key '{RECORD}' is missing: only files that `{cls.__name__}.save` wrote can be loaded")
        result = from_record(cls, root.value[RECORD], f"{path}: {RECORD}")
        assert isinstance(result, cls)
        return result

    def _document(self) -> dict[str, Any]:
        """Return the content of the file."""
        return {"schema": f"optshape/{self.FORM}/1", **self.to_dict(), RECORD: to_record(self)}

    def _repr_html_(self) -> str:
        return f"<p>{markup(repr(self))}</p>{html_table(self.rows())}{picture(self)}"


def dataframe(rows: Sequence[Mapping[str, Any]]) -> pandas.DataFrame:
    """Return rows as a data frame.

    Raises:
        MissingExtraError: pandas is absent.
    """
    try:
        import pandas
    except ImportError as cause:
        raise missing_extra("pandas", "dataframe", cause) from cause
    return pandas.DataFrame(list(rows))


def html_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the first rows as an HTML table; names that come from data are plain text in it."""
    columns = list(dict.fromkeys(name for row in rows[:MOST_ROWS] for name in row))
    if not columns:
        return ""
    head = "".join(f"<th>{markup(name)}</th>" for name in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{markup(_cell(row.get(name)))}</td>" for name in columns) + "</tr>"
        for row in rows[:MOST_ROWS]
    )
    more = f"<p>{len(rows) - MOST_ROWS} more rows</p>" if len(rows) > MOST_ROWS else ""
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}"


def picture(result: object) -> str:
    """Return the picture of a result as HTML; empty if there is none, or no matplotlib.

    Pictures belong to a layer above, so that layer is imported by its name, when a notebook asks.
    """
    try:
        notebook = importlib.import_module("optshape_graph.viz.notebook")
    except ImportError:
        return ""
    drawn: str = notebook.picture(result)
    return drawn


def one_scan(path: str | Path, form: str, kind: type) -> Any:
    """Load the result of one scan from a file whose `scans` list has a record.

    Args:
        path: of the file.
        form: kind of the file.
        kind: class of the result.

    Raises:
        InputError: another file, several scans, or no record.
    """
    root = read_document(path, form)
    scans = root.entries().get("scans")
    if scans is None or len(scans.items()) != 1 or RECORD not in scans.items()[0].entries():
        raise InputError(f"{path}: expected one scan with its '{RECORD}', as `{kind.__name__}.save` writes it")
    return from_record(kind, scans.items()[0].value[RECORD], f"{path}: {RECORD}")


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
