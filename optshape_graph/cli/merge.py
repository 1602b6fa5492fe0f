"""`optshape merge`: make one map of several with landmarks in common."""

from __future__ import annotations

from pathlib import Path

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.html_report import conclude, report_option
from optshape_graph.cli.map import say_landmarks
from optshape_graph.cli.options import FILE, JSON_FILE, example, force_option


@click.command(epilog=example("optshape merge monday.json tuesday.json --json both.json"))
@click.argument("maps", nargs=-1, type=FILE, metavar="MAP...")
@click.option("--json", "json_file", type=JSON_FILE, required=True, help="Write the map (optshape/map/1).")
@report_option
@force_option
def command(maps: tuple[Path, ...], json_file: Path, html: Path | None, force: bool) -> int:
    """Make one map of several, in the frame of the first.

    Each MAP must share landmarks, by name, with those before it, and be independent of them: made of other sessions,
    and not extended from one of them with --known. Joint covariances are kept.
    """
    from functools import reduce

    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.mapping import load_map, merge_maps, save_map

    if len(maps) < 2:
        raise click.UsageError("one map is nothing to merge: name two or more")
    outputs = Outputs([*maps], force=force)
    outputs.file("--json", json_file, "map")
    outputs.file("--report", html)
    result = reduce(merge_maps, [load_map(path) for path in maps])
    save_map(json_file, result)
    say(f"{len(result.landmarks)} landmarks, {len(result.trajectories)} sessions")
    say_landmarks(result, "the first map")
    conclude(result.to_dict(), html)
    return 0
