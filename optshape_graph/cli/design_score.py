"""`optshape design score`: shapes, and the bound on the pose of each, side by side."""

from __future__ import annotations

from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.console import print_table
from optshape_graph.cli.options import (
    DISTANCE,
    FILE,
    JSON_FILE,
    example,
    force_option,
)

if TYPE_CHECKING:
    from optshape_graph.design.judgement import Judgement

SCORE_COLUMNS = """\b
shortest m      the shortest edge
six rotations   the paper's score, worst of its six rotations; every 1, 0.1 deg: worst of all orientations. How far
                the rings' end points move along the rings under the worst small motion: more is better
asymmetry       share of its area that the shape uncovers when turned by the angle at which it is most like
                itself. 0: symmetric, its pose is ambiguous; below about 0.15 a stray return can turn it
e_t             bound on the distance between the estimated and the true origin of the target, mm
e_r             bound on the angle between the estimated and the true rotation, deg; in plane: about the normal

No unbiased estimate has a smaller root mean square error than the bound. It is infinite if all rings end on two
parallel edges, as on a square that stands upright: then the pose is undetermined.

"""


@click.command(
    epilog=SCORE_COLUMNS + example("optshape design score paper pose-optimal board.yaml --sensor os0-64 --range 15")
)
@click.argument("shapes", nargs=-1, required=True, metavar="SHAPE...")
@click.option("--sensor", default="vlp32c", show_default=True, help="To bound the pose for: name or file.")
@click.option("--range", "--distance", "distance", type=DISTANCE, default=10.0, show_default=True,
              help="Of the target from it, m.")  # fmt: skip
@click.option("--plot", type=FILE, help="Write a plot that compares the shapes.")
@click.option("-o", "--json", "--output", "output", type=JSON_FILE, help="Write the numbers to this file.")
@force_option
def command(
    shapes: tuple[str, ...], sensor: str, distance: float, plot: Path | None, output: Path | None, force: bool
) -> None:
    """Judge shapes: score, symmetry, and the Cramer-Rao bound on the pose.

    The score is that of the shape at 1 m2. The bound is for the shape at its own size, facing the sensor: the median
    and the worst over 36 orientations and 3 heights.
    """
    from optshape_graph.cli.console import progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.cli.plots import check_picture
    from optshape_graph.design.judgement import judge
    from optshape_graph.io.documents import write_json
    from optshape_graph.io.sensors import load_sensor
    from optshape_graph.io.targets import load_target

    outputs = Outputs([*shapes, sensor], force=force)
    outputs.file("--output", output, "design-scores")
    outputs.picture("--plot", plot)
    check_picture(plot)
    model = load_sensor(sensor)
    targets = [load_target(shape) for shape in shapes]
    judgements: list[Judgement] = []
    with progress_bar("judging") as progress:
        for target in targets:
            progress(len(judgements), len(targets))
            judgements.append(judge(target, model, distance))
    show_judgements(judgements)
    if output is not None:
        rows = [_row(judgement) for judgement in judgements]
        write_json(output, {"schema": "optshape/design-scores/1", "sensor": model.name, "shapes": rows})
    if plot is not None:
        from optshape_graph.viz.design import plot_comparison
        from optshape_graph.viz.style import save_figure

        save_figure(plot_comparison(judgements), plot)


def show_judgements(judgements: list[Judgement]) -> None:
    """Print a table of shapes: scores, symmetry, and the bound on the pose."""
    names = ["shape", "sides", "area m2", "shortest m", "six rotations", "every 1 deg", "every 0.1 deg", "asymmetry"]
    bounded = [judgement.bound for judgement in judgements if judgement.bound is not None]
    if bounded:
        names += [f"e_t mm at {bounded[0].distance:g} m", "e_r deg", "in plane deg"]
    rows = []
    for judgement in judgements:
        row = _row(judgement)
        cells = [
            row["name"],
            str(row["sides"]),
            f"{row['area_m2']:.3f}",
            f"{row['shortest_edge_m']:.3f}",
            f"{row['score_six_rotations']:.5f}",
            f"{row['score_every_degree']:.5f}",
            f"{row['score_every_tenth_degree']:.5f}",
            f"{row['asymmetry']:.3f} at {row['asymmetry_at_deg']:.0f}°",
        ]
        if judgement.bound is not None:
            for key, unit, digits in (("e_t_m", 1e3, 1), ("e_r_deg", 1, 2), ("e_in_plane_deg", 1, 2)):
                cells.append(" / ".join(_number(value, unit, digits) for value in row[key]))
        rows.append(cells)
    print_table("Shapes at 1 m2, and the bound on the pose of each as it is (median / worst)", names, rows)


def _row(judgement: Judgement) -> dict[str, Any]:
    from math import isfinite

    target, bound = judgement.target, judgement.bound
    row: dict[str, Any] = {
        "name": target.name,
        "sides": len(target),
        "area_m2": target.area,
        "shortest_edge_m": float(target.edge_lengths.min()),
        "score_six_rotations": judgement.six_rotations,
        "score_every_degree": judgement.every_degree,
        "score_every_tenth_degree": judgement.every_tenth,
        "asymmetry": judgement.self_rotation.distance,
        "asymmetry_at_deg": degrees(judgement.self_rotation.angle),
    }
    if bound is not None:
        # null: the pose is not determined in the worst placement.
        for key, values in (
            ("e_t_m", bound.e_t),
            ("e_r_deg", [degrees(value) for value in bound.e_r]),
            ("e_in_plane_deg", [degrees(value) for value in bound.e_in_plane]),
        ):
            row[key] = [value if isfinite(value) else None for value in values]
        row["distance_m"] = bound.distance
    return row


def _number(value: float | None, unit: float, digits: int) -> str:
    return "∞" if value is None else f"{value * unit:.{digits}f}"
