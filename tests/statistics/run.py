"""Run groups of scans, a line of JSON for each as it comes; a run that was stopped goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from tests.statistics.groups import draw
from tests.statistics.judge import Row, estimate_row


def run_groups(names: Sequence[str], seed: int, scans: int, output: Path) -> dict[str, list[Row]]:
    """Estimate so many scans of each group, and return the rows of each, in order.

    Args:
        names: of groups.
        seed: of all.
        scans: of each group.
        output: where the lines are kept; those that are there already count.
    """
    done = {}
    if output.exists():
        for line in output.read_text().splitlines():
            row = json.loads(line)
            done[row["group"], row["seed"], row["index"]] = row
    with output.open("a") as file:
        for index in range(scans):
            for name in names:
                if (name, seed, index) not in done:
                    row = {"group": name, "seed": seed, "index": index, **estimate_row(*draw(name, seed, index))}
                    done[name, seed, index] = row
                    print(json.dumps(row), file=file, flush=True)
    return {name: [done[name, seed, index] for index in range(scans)] for name in names}
