"""`optshape design study`: whether a better score means a better pose."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.options import (
    DISTANCE,
    FOLDER,
    example,
    force_option,
    pool_options,
    seed_option,
)

if TYPE_CHECKING:
    from optshape_graph.runs.workers import Pool

STUDIED = ("square", "diamond", "triangle", "paper", "built@1", "score-optimal", "pose-optimal")


@click.command(epilog=example("optshape design study --shapes 10 --sensor vlp32c --workers 2 -o study"))
@click.option(
    "--shapes",
    type=click.IntRange(0, 10_000),
    default=33,
    show_default=True,
    help="Random shapes, beside the built-in ones.",
)
@click.option("--sensor", default="vlp32c", show_default=True, help="Name or file.")
@click.option("--ranges", "--distances", "distances", default="8,14,20", show_default=True, help="Of the target, m.")
@click.option("--placements", type=click.IntRange(1, 10_000), default=16, show_default=True, help="At each distance.")
@seed_option("Of shapes, placements and noise.")
@pool_options
@force_option
@click.option("-o", "--output", type=FOLDER, default=Path("study"), show_default=True, help="Folder to write to.")
def command(
    shapes: int, sensor: str, distances: str, placements: int, seed: int, pool: Pool | None, force: bool, output: Path
) -> None:
    """Ask whether a better score means a better pose: simulate shapes of 1 m2, and estimate their poses.

    Writes the numbers, a plot, and every finished shape; run it again to go on after an interruption.
    """
    from optshape_graph.cli.console import progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.evaluation.shape_study import random_placements, random_shapes, study_shapes
    from optshape_graph.io.documents import write_json
    from optshape_graph.io.sensors import load_sensor
    from optshape_graph.io.targets import load_target
    from optshape_graph.viz.design import plot_study
    from optshape_graph.viz.style import new_figure, save_figure

    new_figure()  # fails without matplotlib, before the study rather than after it
    outputs = Outputs([sensor], force=force)
    if (output / "shapes" / "sweep.json").exists():  # an older study is replaced
        outputs.folder("--output", output)
    else:
        outputs.folder("--output", output, ["study.json", "study.png"], replace=False)
    try:
        metres = [DISTANCE.convert(text, None, None) for text in distances.split(",")]
    except click.BadParameter as error:
        raise click.BadParameter(
            f"expected numbers with commas between, found '{distances}': {error.message}"
        ) from error
    targets = [load_target(name) for name in STUDIED] + random_shapes(shapes, seed)
    poses = random_placements(metres, placements, seed)
    with progress_bar("shapes") as progress:
        found = study_shapes(targets, load_sensor(sensor), poses, seed, output / "shapes", pool=pool, progress=progress)
    for name, text in (("score", "score"), ("bound_r", "Cramer-Rao bound")):
        result = found.correlation(name)
        say(f"rank correlation of the {text} with the median e_r: {result.rho:+.2f} (p = {result.p_value:.1g})")
    write_json(output / "study.json", {"schema": "optshape/design-study/1", **found.summary()})
    say(f"wrote {output / 'study.json'}")
    save_figure(plot_study(found), output / "study.png")
