"""Run the groups, a line of JSON for each scan as it comes, and print what they add up to.

    python -m tests.statistics --seed 1 --scans 100 --output rows.jsonl [--group "cast hexagon"]

A run that was stopped goes on where it was. `--package` estimates with the package in another folder.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scans", type=int, default=100, help="of each group")
    parser.add_argument("--group", action="append", help="only these groups")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--package", type=Path, help="folder whose optshape_graph estimates")
    arguments = parser.parse_args()
    if arguments.package:
        sys.path.insert(0, str(arguments.package))

    from tests.statistics.groups import GROUPS, draw
    from tests.statistics.judge import estimate_row
    from tests.statistics.report import print_report

    names = arguments.group or list(GROUPS)
    rows = {}
    if arguments.output.exists():
        for line in arguments.output.read_text().splitlines():
            row = json.loads(line)
            rows[row["group"], row["seed"], row["index"]] = row
    with arguments.output.open("a") as file:
        for index in range(arguments.scans):
            for name in names:
                key = (name, arguments.seed, index)
                if key in rows:
                    continue
                row = estimate_row(*draw(name, arguments.seed, index))
                rows[key] = {"group": name, "seed": arguments.seed, "index": index, **row}
                print(json.dumps(rows[key]), file=file, flush=True)
    chosen = {
        name: [row for (group, seed, k), row in rows.items()
               if group == name and seed == arguments.seed and k < arguments.scans]
        for name in names
    }  # fmt: skip
    print_report(chosen)


main()
