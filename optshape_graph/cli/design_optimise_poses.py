"""`optshape design optimise-poses`: the shape whose pose is known best."""

from __future__ import annotations

from math import radians
from pathlib import Path

import click

from optshape_graph.cli.console import print_table, say
from optshape_graph.cli.options import (
    DISTANCE,
    FILE,
    POSITIVE,
    Number,
    example,
    force_option,
    seed_option,
)


@click.command(epilog=example("optshape design optimise-poses --sides 3 --starts 6 -o mine.yaml"))
@click.option("--sides", type=click.IntRange(3, 8), default=3, show_default=True, help="Sides of the polygon.")
@click.option("--sensor", "sensors", multiple=True, default=("vlp32c", "vlp16", "os1-64"), show_default=True,
              help="Sensor, name or file; several.")  # fmt: skip
@click.option("--range", "ranges", multiple=True, type=DISTANCE, default=(10.0, 20.0, 30.0), show_default=True,
              help="Of the target, m; several.")  # fmt: skip
@click.option("--reference", default="paper", show_default=True, help="Shape against which errors are measured.")
@click.option("--area", type=Number(1e-6, 1000.0), default=1.0, show_default=True, help="Of the target, m2.")
@click.option("--shortest-edge", type=POSITIVE, help="At least, m.  [default: 0.4 for 1 m2, and in proportion]")
@click.option("--smallest-angle-deg", type=Number(0.0, 180.0, open=True), default=35.0, show_default=True,
              help="At least, between two edges.")  # fmt: skip
@click.option("--aspect", type=Number(1.0, 1000.0), default=2.6, show_default=True,
              help="At most: the diameter over the smallest width.")  # fmt: skip
@click.option("--asymmetry", type=Number(0.0, 1.0, open=True), default=0.24, show_default=True,
              help="At least; with less, a stray return can turn the shape.")  # fmt: skip
@click.option("--starts", type=click.IntRange(1, 1000), default=6, show_default=True, help="Random starts.")
@click.option("--placements", type=click.IntRange(4, 10_000), default=96, show_default=True,
              help="Of each sensor at each range.")  # fmt: skip
@seed_option("Of the starts.")
@click.option("-o", "--output", type=FILE, default=Path("target.yaml"), show_default=True, help="Target file to write.")
@force_option
def command(
    sides: int,
    sensors: tuple[str, ...],
    ranges: tuple[float, ...],
    reference: str,
    area: float,
    shortest_edge: float | None,
    smallest_angle_deg: float,
    aspect: float,
    asymmetry: float,
    starts: int,
    placements: int,
    seed: int,
    output: Path,
    force: bool,
) -> None:
    """Find the shape whose pose is known best: the bound on both errors, over sensors, ranges, tilts and lost rings.

    The search minimises the median and the 95th percentile of e_r and e_t, for each sensor at each range, relative to
    those of the reference shape of the same area. It takes minutes.
    """
    import numpy as np

    from optshape_graph.cli.console import progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.design.family import Family
    from optshape_graph.design.limits import Limits
    from optshape_graph.design.pose_search import Placements, PoseProblem, search_for_poses
    from optshape_graph.io.sensors import load_sensor
    from optshape_graph.io.targets import load_target, save_target

    Outputs([*sensors, reference], force=force).file("--output", output, "target", replace=False)
    edge = 0.4 * area**0.5 if shortest_edge is None else shortest_edge
    limits = Limits(area, edge, radians(smallest_angle_deg), aspect, asymmetry)
    models = tuple(load_sensor(sensor) for sensor in sensors)
    problem = PoseProblem(Placements(models, ranges, placements), load_target(reference), Family(sides), limits)
    with progress_bar("starts") as progress:
        found = search_for_poses(problem, starts, seed, output.stem, progress=progress)
    save_target(output, found.target)
    ratios = problem.ratios(found.target)
    cells = [f"{sensor} at {metres:g} m" for sensor in sensors for metres in ranges]
    print_table(
        f"Bounds of {found.target.name} over those of {reference}",
        ["", "e_r median", "95 %", "e_t median", "95 %"],
        [
            *([cell, *(f"{ratio:.2f}" for ratio in row.ravel())] for cell, row in zip(cells, ratios, strict=True)),
            ["geometric mean", *(f"{ratio:.2f}" for ratio in np.exp(np.log(ratios).mean(axis=0)).ravel())],
        ],
    )
    say(f"wrote {output}")
