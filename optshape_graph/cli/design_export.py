"""`optshape design export`: the drawing of a target for the workshop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.options import (
    FILE,
    PAPER,
    Number,
    example,
    force_option,
)

if TYPE_CHECKING:
    from optshape_graph.design.sheets import Orientation


@click.command(epilog=example("optshape design export board.yaml --format pdf --paper a3 --markers 15 -o board.pdf"))
@click.argument("shape")
@click.option("--format", "suffix", type=click.Choice(["svg", "dxf", "pdf"]), default="pdf", show_default=True)
@click.option("--paper", type=PAPER, help="Spread SVG or PDF over sheets.  [default: one large sheet]")
@click.option("--orientation", type=click.Choice(["auto", "portrait", "landscape"]), default="auto", show_default=True,
              help="Of the sheets; auto: whichever needs fewer.")  # fmt: skip
@click.option("--markers", "marker_inset", type=Number(0.0, 1000.0), default=0.0, metavar="MM",
              help="Mark where motion-capture markers go: this far in from each corner.")  # fmt: skip
@click.option("--holes", nargs=2, type=Number(0.0, 1000.0), default=(0.0, 30.0), metavar="MM MM",
              help="Diameter of a hole at each corner, and how far in from it.")  # fmt: skip
@click.option("-o", "--output", type=FILE, help="File to write.  [default: SHAPE.FORMAT]")
@force_option
def command(
    shape: str,
    suffix: str,
    paper: str | None,
    orientation: Orientation,
    marker_inset: float,
    holes: tuple[float, float],
    output: Path | None,
    force: bool,
) -> None:
    """Draw a target at 1:1: the face that the LiDAR sees, its dimensions, and what the file has printed on it.

    A chessboard, tags, or both (ChArUco) are drawn black, and nothing over them. Several sheets come with a plan. The
    parts are listed.

    The drawing is the mirror image of the vertex list, which is given as seen from behind. The target's file
    is written beside the drawing, unless it is there. An existing drawing is replaced only with --force.
    """
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.design.drawing import Workshop, draw
    from optshape_graph.design.formats import export, files_of
    from optshape_graph.design.parts import parts_list
    from optshape_graph.design.sheets import lay_out
    from optshape_graph.io.targets import load_target, save_target
    from optshape_graph.names import file_name

    target = load_target(shape)
    path = Path(f"{file_name(target.name)}.{suffix}") if output is None else output
    if path.suffix.lower() != f".{suffix}":
        raise click.UsageError(f"--format {suffix} writes a .{suffix} file; found {path}")
    workshop = Workshop(marker_inset, *holes)
    drawing, sheet = draw(target, workshop), None if paper is None else paper.upper()
    description = path.with_suffix(".yaml")
    outputs = Outputs([shape], force=force)
    for file in files_of(drawing, path, sheet, orientation):
        outputs.new("--output", file)
    sheets = lay_out(drawing, sheet, orientation) if suffix != "dxf" else None
    parts = parts_list(target, workshop, sheets)
    for written in export(drawing, path, sheet, orientation, parts):
        say(f"wrote {written}")
    say("parts:")
    for part in parts:
        say(f"  {part}")
    if not description.exists():
        save_target(description, target)
        say(f"wrote {description}")
