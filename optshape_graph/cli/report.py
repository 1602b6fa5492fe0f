"""What a command over many scans prints: a table of few, counts of many, and the reasons."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from optshape_graph.cli.console import print_table, say, warn
from optshape_graph.cli.html_report import conclude
from optshape_graph.runs.journal import Journal

MOST_ROWS = 500
"""Scans that a table shows; of more, how many ended how."""

MOST_REASONS = 100
"""Lines on standard error."""


def report(
    results: Journal,
    title: str,
    columns: Sequence[str],
    rows_of: Callable[[dict[str, Any], str], list[list[str]]],
    note: str,
    output: Path | None,
    html: Path | None,
    form: str,
) -> int:
    """Print the results of a run over scans, and return the exit status.

    Args:
        results: a line for each scan, with `status`, `reasons` and `entry`.
        title: of the table.
        columns: their headings.
        rows_of: rows of an entry of the document and its status.
        note: below the table.
        output: the document; None: none was written.
        html: the report of the first `MOST_ROWS` scans; None: none.
        form: of the document: "estimate" or "detect".
    """
    if results.count <= MOST_ROWS:
        rows = [row for line in results for row in rows_of(json.loads(line["entry"]), line["status"])]
        print_table(title, columns, rows, note)
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
