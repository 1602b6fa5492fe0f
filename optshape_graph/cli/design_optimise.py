"""`optshape design optimise`: the shape whose worst score is best."""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import TYPE_CHECKING

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.design_score import show_judgements
from optshape_graph.cli.options import (
    DISTANCE,
    FILE,
    FOLDER,
    PAPER,
    POSITIVE,
    Number,
    example,
    force_option,
    pool_options,
    seed_option,
)

if TYPE_CHECKING:
    from optshape_graph.runs.workers import Pool


@click.command(
    epilog=example("optshape design optimise --sides 4 --starts 16 --aspect 2.5 -o mine.yaml --plot pictures")
)
@click.option("--sides", type=click.IntRange(3, 24), default=4, show_default=True, help="Sides of the polygon.")
@click.option(
    "--rings", nargs=2, type=click.IntRange(1, 100), default=(5, 4), show_default=True, help="Areas, and rings in each."
)
@click.option("--sensor", help="Take the rings of this sensor instead (name or file), at --range.")
@click.option("--range", "--distance", "distance", type=DISTANCE, default=10.0, show_default=True,
              help="Of the target from the sensor, m.")  # fmt: skip
@click.option("--area", type=Number(1e-6, 1000.0), default=1.0, show_default=True, help="Of the target, m2.")
@click.option("--shortest-edge", type=POSITIVE, help="At least, m.  [default: 0.4 for 1 m2, and in proportion]")
@click.option("--smallest-angle-deg", type=Number(0.0, 180.0), help="At least, between two edges.")
@click.option("--aspect", type=Number(1.0, 1000.0), help="At most: the diameter over the smallest width.")
@click.option(
    "--asymmetry", type=Number(0.0, 10.0), default=0.12, show_default=True, help="At least; 0 allows symmetric shapes."
)
@click.option("--sheet", type=PAPER, help="The target fits on this sheet whole.")
@click.option("--starts", type=click.IntRange(1, 100_000), default=64, show_default=True, help="Random starts.")
@seed_option("Of the starts: the same seed finds the same shape.")
@pool_options
@force_option
@click.option("--name", help="Of the target.  [default: the output's]")
@click.option("--plot", "--plots", "plots", type=FOLDER, metavar="DIR", help="Write pictures of the result here.")
@click.option("-o", "--output", type=FILE, default=Path("target.yaml"), show_default=True, help="Target file to write.")
def command(
    sides: int,
    rings: tuple[int, int],
    sensor: str | None,
    distance: float,
    area: float,
    shortest_edge: float | None,
    smallest_angle_deg: float | None,
    aspect: float | None,
    asymmetry: float,
    sheet: str | None,
    starts: int,
    seed: int,
    pool: Pool | None,
    force: bool,
    name: str | None,
    plots: Path | None,
    output: Path,
) -> None:
    """Find the shape whose worst score is best: the paper's aim. For poses: `optimise-poses`.

    The worst score is that over all orientations and all partly lit areas. Finished starts are kept in a folder beside
    OUTPUT; run the same command again to go on after an interruption. An existing target
    file without such a folder is replaced only with --force.
    """
    from optshape_graph.cli.console import progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.design.family import Family
    from optshape_graph.design.judgement import judge
    from optshape_graph.design.limits import SHEETS, Limits
    from optshape_graph.design.multistart import search
    from optshape_graph.design.problem import Problem
    from optshape_graph.design.rings import SensorRings, UniformRings
    from optshape_graph.io.sensors import load_sensor
    from optshape_graph.io.targets import save_target

    folder = output.with_suffix(".starts")
    outputs = Outputs([sensor], force=force)
    outputs.folder("--output", folder)
    if output.exists() or output.parent.is_dir():  # else its folder is made with that of the starts
        outputs.file("--output", output, "target", replace=folder.is_dir())
    outputs.folder("--plot", plots)
    if plots is not None:
        from optshape_graph.viz.style import new_figure

        new_figure()  # fails without matplotlib, before the search rather than after it
    limits = Limits(
        area=area,
        shortest_edge=0.4 * max(area, 0.0) ** 0.5 if shortest_edge is None else shortest_edge,
        smallest_angle=None if smallest_angle_deg is None else radians(smallest_angle_deg),
        aspect=aspect,
        asymmetry=asymmetry or None,
        sheet=None if sheet is None else SHEETS[sheet.upper()],
    )
    lit = SensorRings.of(load_sensor(sensor), distance, area=area) if sensor else UniformRings(*rings)
    problem = Problem(Family(sides), lit, limits)
    with progress_bar("starts") as progress:
        found = search(problem, starts, seed, pool, folder, progress)
    target = found.target(name or output.stem)
    save_target(output, target)
    say(f"best of {starts} starts (number {found.best.index}): score {found.best.score:.5f}; wrote {output}")
    judgement = judge(target)
    show_judgements([judgement])
    if plots is not None:
        from optshape_graph.viz import design as viz
        from optshape_graph.viz.style import save_figure

        save_figure(viz.plot_comparison([judgement]), plots / "shape.png")
        save_figure(viz.plot_cells(target, lit), plots / "cells.png")
        save_figure(viz.plot_sensitivity(target, lit), plots / "sensitivity.png")
        save_figure(viz.plot_search(found), plots / "search.png")
        save_figure(viz.plot_convexity(), plots / "convexity.png")
