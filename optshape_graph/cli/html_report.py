"""`optshape report`, and the option `--report FILE` of every command that estimates."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.options import FILE, example, force_option
from optshape_graph.names import shell_word


def report_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--report FILE` to a command; it takes the value as `html`."""
    return click.option(
        "--report", "html", type=FILE, metavar="FILE.html",
        help="Write verdict, numbers, pictures (with --plot) and what to do next to one HTML file.",
    )(function)  # fmt: skip


def conclude(document: Mapping[str, Any], html: Path | None, pictures: Sequence[str | Path] = ()) -> None:
    """Print what a result means in one line, and write the report if one is asked for.

    Args:
        document: the result's plain form.
        html: the report; None: none.
        pictures: that were drawn.
    """
    from optshape_graph.evaluation.verdicts import verdict_of

    if html is None:
        say(verdict_of(document).line)
        return
    from optshape_graph.viz.report import write_report

    words = [Path(sys.argv[0]).name, *sys.argv[1:]]
    say(write_report(html, document, pictures, " ".join(map(shell_word, words))).line)
    say(f"wrote {html}")


@click.command(epilog=example("optshape report calibration.json -o report.html pictures/*.png"))
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.json")
@click.argument("pictures", nargs=-1, type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("-o", "--output", type=FILE, default=Path("report.html"), show_default=True, help="File to write.")
@force_option
def command(result: Path, pictures: tuple[Path, ...], output: Path, force: bool) -> None:
    """Write what a result means as one HTML file: verdict, numbers, pictures, what to do next.

    RESULT.json comes from estimate, detect, calibrate, map, evaluate or design choose; PICTURES are drawings of it.
    """
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.evaluation.verdicts import JUDGED, kind_of
    from optshape_graph.io.documents import check_document, read_json

    Outputs([result, *pictures], force=force).file("--output", output)
    document = read_json(result)
    schema = document.fields(["schema"])["schema"]
    kind = kind_of(document.value)
    if kind not in JUDGED:
        schema.expected(f"the result of {', '.join(JUDGED)}")
    check_document(document, kind)
    conclude(document.value, output, pictures)
