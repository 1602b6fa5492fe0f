"""Output of a command over many scans: a table of few scans, counts of many, and the reasons of failures."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from optshape_graph.cli.console import print_table, progress_bar, say, warn
from optshape_graph.cli.html_report import conclude
from optshape_graph.runs.journal import Journal

if TYPE_CHECKING:
    from optshape_graph.runs.workers import Pool

MOST_ROWS = 500
"""Scans that a table shows at most; of more scans only the number of each status is printed."""

MOST_REASONS = 100
"""Reasons that are printed at most, on standard error."""


@dataclass(frozen=True)
class Table:
    """The table of scans.

    Attributes:
        title: above it.
        columns: their headings.
        rows_of: returns the rows for an entry of the document and its status.
        note: below it.
    """

    title: str
    columns: Sequence[str]
    rows_of: Callable[[dict[str, Any], str], list[list[str]]]
    note: str


def run_over(
    task: Any,
    paths: Sequence[str],
    table: Table,
    form: Literal["estimate", "detect"],
    *,
    output: Path | None,
    html: Path | None,
    plots: Path | None,
    pool: Pool | None,
) -> int:
    """Run a task over scans, print the results, and return the exit status.

    Args:
        task: of paths, with `failed`, `describe` and `AT_ONCE`: see `runs.files.run_files`.
        paths: of the scans.
        table: what is printed.
        form: of the document.
        output: the document; None: none is written.
        html: the report of the first `MOST_ROWS` scans; None: none.
        plots: folder of pictures, or None. A run with pictures does not take results from a journal without them.
        pool: the workers; None: this process.
    """
    from optshape_graph.runs.files import run_files

    what = task.describe() | {"pictures": str(plots.resolve()) if plots else None}
    with (
        progress_bar(f"{form.removesuffix('e')}ing") as progress,
        run_files(task, paths, task.failed, form=form, describe=what, output=output, pool=pool,
                  progress=progress, at_once=task.AT_ONCE) as results,
    ):  # fmt: skip
        return report(results, table, output, html, form)


def report(results: Journal, table: Table, output: Path | None, html: Path | None, form: str) -> int:
    """Print the results of a run over scans, and return the exit status.

    Args:
        results: a line for each scan, with `status`, `reasons` and `entry`.
        table: what is printed.
        output: the document; None: none was written.
        html: the report; None: none.
        form: of the document.
    """
    if results.count <= MOST_ROWS:
        rows = [row for line in results for row in table.rows_of(json.loads(line["entry"]), line["status"])]
        print_table(table.title, table.columns, rows, table.note)
    statuses: Counter[str] = Counter()
    reasons = 0
    for line in results:
        statuses[line["status"]] += 1
        for picture in line.get("pictures", []):
            say(f"picture: {picture}")
        for reason in line["reasons"]:
            reasons += 1
            if reasons <= MOST_REASONS:
                warn(reason)
    if reasons > MOST_REASONS:
        where = f": see {output}" if output else "; --json keeps them all"
        warn(f"{reasons - MOST_REASONS} more reasons are not shown{where}")
    if results.count > MOST_ROWS:
        say(f"{results.count} scans: " + ", ".join(f"{count} {status}" for status, count in statuses.most_common()))
    lines = list(islice(iter(results), MOST_ROWS))
    document = {"schema": f"optshape/{form}/1", "scans": [json.loads(line["entry"]) for line in lines]}
    conclude(document, html, [picture for line in lines for picture in line.get("pictures", [])])
    return 0 if not reasons and set(statuses) <= {"ok"} else 3
