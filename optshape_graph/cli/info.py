"""`optshape info`: say what a file is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from optshape_graph.cli.console import say, warn
from optshape_graph.cli.options import JSON_FILE, example, force_option


@click.command(epilog=example("optshape info drive.bag scan.pcd board.yaml"))
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FILE...")
@click.option("--columns", metavar="NAMES", help="Names of the columns, for a cloud without names: x,y,z,_,ring.")
@click.option("--json", "json_path", type=JSON_FILE, help="Write the facts to this file.")
@force_option
def command(files: tuple[Path, ...], columns: str | None, json_path: Path | None, force: bool) -> int:
    """Say what each FILE is: form, fields and units, rings, times, topics and spans, and the sensor it looks like.

    FILE is anything that the package reads: a cloud, a bag, a folder of clouds, captured packets, a session, a camera,
    a sensor, motion capture, a trajectory, a result, an image. Exit status 3: some files are of no form that is read.
    """
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.errors import OptshapeError
    from optshape_graph.io.describe import describe
    from optshape_graph.io.documents import write_json

    Outputs(files, force=force).file("--json", json_path, "info")
    found: list[dict[str, Any]] = []
    problems: list[OptshapeError] = []
    for file in files:
        try:
            facts = describe(file, None if columns is None else columns.split(","))
        except OptshapeError as error:
            problems.append(error)
            found.append({"file": str(file), "form": None, "problem": str(error)})
            continue
        facts |= _verdict(file, str(facts["form"]))
        found.append({"file": str(file), **facts})
        say(file)
        _print(facts, 2)
    if json_path:
        write_json(json_path, {"schema": "optshape/info/1", "files": found})
    none_is_read = len(problems) == len(files)
    for problem in problems[none_is_read:]:
        warn(problem)
    if none_is_read:
        raise problems[0]
    return 3 if problems else 0


def _verdict(file: Path, form: str) -> dict[str, str]:
    """Return the verdict on a file that is a result; nothing of others, and of results that are not whole."""
    from optshape_graph.errors import InputError
    from optshape_graph.evaluation.verdicts import JUDGED, kind_of, verdict_of
    from optshape_graph.io.documents import read_document

    kind = kind_of({"schema": form})
    if kind not in JUDGED:
        return {}
    try:
        return {"verdict": verdict_of(read_document(file, kind).value).line}
    except InputError:
        return {}


def _print(facts: dict[str, Any], indent: int) -> None:
    width = max((len(name) for name in facts), default=0)
    for name, value in facts.items():
        if name == "numbers":
            continue  # the same facts for programs
        if isinstance(value, dict):
            say(" " * indent + name)
            _print(value, indent + 2)
        else:
            say(" " * indent + f"{name:<{min(width, 24)}}  {value}")
