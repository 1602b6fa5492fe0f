"""`optshape design measured`: the target that came out of the workshop."""

from __future__ import annotations

from pathlib import Path

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.options import (
    FILE,
    POSITIVE,
    example,
    force_option,
)


@click.command(
    epilog=example(
        "optshape design measured board.yaml --length 0-1=941.5 --length 1-2=1120 --length 2-3=629 \\",
        "--length 3-0=1549 --length 0-2=1627 --check-bar 99.6 -o as-built.yaml",
    )
)
@click.argument("shape")
@click.option("--length", "lengths", multiple=True, metavar="I-J=MM", help="Measured distance of vertices I and J, mm.")
@click.option("--check-bar", type=POSITIVE, help="Measured length of the drawing's 100 mm bar: scales the pattern.")
@click.option("-o", "--output", type=FILE, required=True, help="Target file to write.")
@force_option
def command(shape: str, lengths: tuple[str, ...], check_bar: float | None, output: Path, force: bool) -> None:
    """Put the measured sides of a target back into its file.

    Measure every side and at least one diagonal, by the vertices' numbers on the drawing, to a millimetre.
    """
    import re

    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.design.drawing import CHECK
    from optshape_graph.design.measured import as_measured
    from optshape_graph.io.targets import load_target, save_target

    Outputs([shape], force=force).file("--output", output, "target")
    target, pairs = load_target(shape), {}
    for text in lengths:
        match = re.fullmatch(r"(\d{1,4})-(\d{1,4})=(\d{1,6}(?:\.\d{1,6})?)", text.strip())
        if match is None:
            raise click.BadParameter(f"expected I-J=MM, as 0-1=941.5; found '{text}'", param_hint="--length")
        pairs[int(match[1]), int(match[2])] = float(match[3]) / 1000.0
    if not pairs and check_bar is None:
        raise click.UsageError("expected a --length or a --check-bar: nothing was measured")
    built = as_measured(target, pairs, 1.0 if check_bar is None else check_bar / CHECK)
    save_target(output, built)
    moved = 1000.0 * abs(built.polygon - target.polygon).max()
    say(f"wrote {output}: vertices moved by up to {moved:.1f} mm, area {built.area:.4f} m2 (drawn: {target.area:.4f})")
