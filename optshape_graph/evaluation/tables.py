"""Tables of results: files of rows, summaries by group, and our results beside the paper's."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optshape_graph._arrays import shortened
from optshape_graph.errors import InputError, missing_extra
from optshape_graph.evaluation.harness import Row
from optshape_graph.evaluation.published import TABLE_1, PublishedRow
from optshape_graph.io.files import read_bytes, write_atomically
from optshape_graph.io.results import dataframe, html_table, picture
from optshape_graph.names import markup

if TYPE_CHECKING:
    import pandas

ERRORS = ("rmse_m", "e_t_m", "e_r_deg")
"""Columns of errors that are summarised."""


class Table(list[Row]):
    """Rows of a sweep: a list of dictionaries that prints in one line, and becomes a data frame or a file."""

    def __repr__(self) -> str:
        return shortened(f"Table({len(self)} rows: {', '.join(_columns(self))})")

    def _repr_html_(self) -> str:
        return f"<p>{markup(repr(self))}</p>{html_table(self)}{picture(self)}"

    def to_dict(self) -> dict[str, list[Any]]:
        """Return the columns by name."""
        return {name: [row.get(name) for row in self] for name in _columns(self)}

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the rows as a data frame.

        Raises:
            MissingExtraError: pandas is absent.
        """
        return dataframe(self)

    def save(self, path: str | Path) -> None:
        """Write the rows as CSV, or as Parquet if the name ends in .parquet.

        Args:
            path: of the file.

        Raises:
            InputError: the file cannot be written.
            MissingExtraError: Parquet is asked for, and pyarrow is absent.
        """
        (write_parquet if Path(path).suffix == ".parquet" else write_csv)(path, self)

    @classmethod
    def load(cls, path: str | Path) -> Table:
        """Read the rows of a Parquet file, equal to the saved ones; CSV does not distinguish numbers from text.

        Args:
            path: of the file.

        Raises:
            InputError: no Parquet file.
            MissingExtraError: pyarrow is absent.
        """
        pa, pq = _pyarrow()
        try:
            return cls(pq.read_table(pa.BufferReader(read_bytes(path))).to_pylist())
        except pa.ArrowException as error:
            raise InputError(f"{path}: not a Parquet file ({error})") from error


def write_csv(path: str | Path, rows: Sequence[Row]) -> None:
    """Write rows as CSV, with numbers that read back exactly, and empty missing values.

    Raises:
        InputError: the file cannot be written.
    """
    stream = io.StringIO()
    writer = csv.DictWriter(stream, fieldnames=_columns(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, stream.getvalue())


def write_parquet(path: str | Path, rows: Sequence[Row]) -> None:
    """Write rows as Parquet.

    Raises:
        MissingExtraError: pyarrow is absent.
        InputError: the file cannot be written.
    """
    pa, pq = _pyarrow()
    table = pa.table({name: [row.get(name) for row in rows] for name in _columns(rows)})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    write_atomically(path, sink.getvalue().to_pybytes())


def summarise(rows: Iterable[Row], by: Sequence[str]) -> list[Row]:
    """Return one row for each group: number of scans, their statuses, and the errors of those with a pose.

    Args:
        rows: from `run_simulation`.
        by: columns whose values make a group.

    Returns:
        For every error its mean, median, 95th percentile and maximum over all estimates of any status; and, if the rows
        have it, the median of its bound. `worst_ok_e_r_deg` is over the estimates that are ok.
    """
    return by_group(rows, by, _summary)


def by_group(rows: Iterable[Row], by: Sequence[str], reduce: Callable[[list[Row]], Row]) -> list[Row]:
    """Return one row for each group, in order of appearance: the columns `by`, and what `reduce` makes of its rows."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    return [dict(zip(by, key, strict=True)) | reduce(group) for key, group in groups.items()]


def _summary(group: list[Row]) -> Row:
    status = [row["status"] for row in group]
    summary: Row = {"scans": len(group)} | {
        name: status.count(name) for name in ("ok", "doubtful", "ambiguous", "failed")
    }
    for name in ("distance_m", "n_points", "e_q_m"):
        summary[name] = float(np.mean([row[name] for row in group]))
    for name in ERRORS:
        values = np.array([row[name] for row in group if row[name] is not None])
        bounds = [row[f"bound_{name}"] for row in group if row.get(f"bound_{name}") is not None]
        summary |= {
            f"{name}_mean": float(values.mean()) if len(values) else None,
            f"{name}_median": float(np.median(values)) if len(values) else None,
            f"{name}_p95": float(np.quantile(values, 0.95)) if len(values) else None,
            f"{name}_max": float(values.max()) if len(values) else None,
            f"{name}_bound": float(np.median(bounds)) if bounds else None,
        }
    ok = [row["e_r_deg"] for row in group if row["status"] == "ok"]
    summary["worst_ok_e_r_deg"] = max(ok) if ok else None
    return summary


def beside_published(cells: Iterable[Row], published: Sequence[PublishedRow] = TABLE_1) -> list[Row]:
    """Put the paper's rows beside our medians at the same orientation and the nearest distance within 10 cm.

    Args:
        cells: from `summarise`, by method, orientation and range, of one noise level.
        published: the paper's table.
    """
    cells = list(cells)
    beside = []
    for printed in published:
        row: Row = {f"published_{name}" if name in ("n_points", "e_q_m", *ERRORS) else name: value
                    for name, value in printed._asdict().items() if not name.endswith("_pct")}  # fmt: skip
        for cell in cells:
            near = abs(cell["distance_m"] - printed.distance_m) < 0.1
            if cell["orientation"] == printed.orientation and near:
                row |= {"n_points": cell["n_points"], "e_q_m": cell["e_q_m"], "bound_rmse_m": cell["rmse_m_bound"]}
                row |= {f"{cell['method']}_{name}": cell[f"{name}_median"] for name in ERRORS}
        beside.append(row)
    return beside


def check_parquet() -> None:
    """Check before the work that Parquet can be written.

    Raises:
        MissingExtraError: pyarrow is absent.
    """
    _pyarrow()


def _pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as cause:
        raise missing_extra("pyarrow", "evaluate", cause) from cause
    return pa, pq


def _columns(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))
