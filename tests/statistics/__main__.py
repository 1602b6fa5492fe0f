"""Run the groups and print what they add up to.

    python -m tests.statistics --seed 1 --scans 100 --output rows.jsonl [--group "cast hexagon"]

`--package` estimates with the package in another folder, such as a checkout of a former version.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scans", type=int, default=100, help="of each group")
    parser.add_argument("--group", action="append", help="only these groups")
    parser.add_argument("--output", type=Path, required=True, help="lines of JSON; a run goes on where it was")
    parser.add_argument("--package", type=Path, help="folder whose optshape_graph estimates")
    arguments = parser.parse_args()
    if arguments.package:
        sys.path.insert(0, str(arguments.package))

    from tests.statistics.groups import GROUPS
    from tests.statistics.report import print_report
    from tests.statistics.run import run_groups

    names = arguments.group or list(GROUPS)
    print_report(run_groups(names, arguments.seed, arguments.scans, arguments.output))


main()
