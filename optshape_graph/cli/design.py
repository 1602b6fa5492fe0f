"""`optshape design`: find a target shape, judge shapes, draw one for the workshop."""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.design_choose import choose, measured, optimise_poses
from optshape_graph.cli.options import (
    DISTANCE,
    FILE,
    FOLDER,
    JSON_FILE,
    POSITIVE,
    Number,
    example,
    force_option,
    pool_options,
    seed_option,
)

if TYPE_CHECKING:
    from optshape_graph.design.judgement import Judgement
    from optshape_graph.design.sheets import Orientation
    from optshape_graph.runs.workers import Pool

STUDIED = ("square", "diamond", "triangle", "paper", "built@1", "score-optimal", "pose-optimal")
PAPERS = click.Choice(["A0", "A1", "A2", "A3", "A4"], case_sensitive=False)


SCORE_COLUMNS = """\b
shortest m      the shortest edge
six rotations   the paper's score, worst of its six rotations; every 1, 0.1 deg: worst of all orientations. How far
                the rings' end points move along the rings under the worst small motion: more is better
asymmetry       share of itself that the shape uncovers when it is turned by the angle at which it is most like
                itself: 0: symmetric, its pose is ambiguous; below about 0.15 a stray return can turn it
e_t             bound on the distance between the estimated and the true origin of the target, mm
e_r             bound on the angle between the estimated and the true rotation, deg; in plane: about the normal

No unbiased estimate has a smaller root mean square error than the bound. An infinite one: rings that end on two
parallel edges only, as on a square that stands upright, leave the pose undetermined.

"""


@click.group()
def command() -> None:
    """Design target shapes: find one, judge them, draw one at 1:1.

    A SHAPE is a built-in name (square, paper, pose-optimal, ...), NAME@AREA in m2, or a target file.
    """


command.add_command(choose)
command.add_command(measured)
command.add_command(optimise_poses)


@command.command(
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
@click.option("--sheet", type=PAPERS, help="The target fits on this sheet whole.")
@click.option("--starts", type=click.IntRange(1, 100_000), default=64, show_default=True, help="Random starts.")
@seed_option("Of the starts: the same seed finds the same shape.")
@pool_options
@force_option
@click.option("--name", help="Of the target.  [default: the output's]")
@click.option("--plot", "--plots", "plots", type=FOLDER, metavar="DIR", help="Write pictures of the result here.")
@click.option("-o", "--output", type=FILE, default=Path("target.yaml"), show_default=True, help="Target file to write.")
def optimise(
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

    The worst is taken over every orientation and every partly lit area. Finished starts are kept in OUTPUT's folder,
    in a folder named after it; run the same command again to go on after an interruption. A target file that no search
    of that name has made is written over only with --force.
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

        new_figure()  # whether there is matplotlib: better known before the search than after it
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
    _show([judgement])
    if plots is not None:
        from optshape_graph.viz import design as viz
        from optshape_graph.viz.style import save_figure

        save_figure(viz.plot_comparison([judgement]), plots / "shape.png")
        save_figure(viz.plot_cells(target, lit), plots / "cells.png")
        save_figure(viz.plot_sensitivity(target, lit), plots / "sensitivity.png")
        save_figure(viz.plot_search(found), plots / "search.png")
        save_figure(viz.plot_convexity(), plots / "convexity.png")


@command.command(
    epilog=SCORE_COLUMNS + example("optshape design score paper pose-optimal board.yaml --sensor os0-64 --range 15")
)
@click.argument("shapes", nargs=-1, required=True, metavar="SHAPE...")
@click.option("--sensor", default="vlp32c", show_default=True, help="To bound the pose for: name or file.")
@click.option("--range", "--distance", "distance", type=DISTANCE, default=10.0, show_default=True,
              help="Of the target from it, m.")  # fmt: skip
@click.option("--plot", type=FILE, help="Write a plot that compares the shapes.")
@click.option("-o", "--json", "--output", "output", type=JSON_FILE, help="Write the numbers to this file.")
@force_option
def score(
    shapes: tuple[str, ...], sensor: str, distance: float, plot: Path | None, output: Path | None, force: bool
) -> None:
    """Judge shapes: score, symmetry, and the Cramer-Rao bound on the pose.

    Scores are those of the shape at 1 m2; the bound is that of the shape at the size it has, facing the sensor, over
    36 orientations and 3 heights: the median and the worst.
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
    _show(judgements)
    if output is not None:
        rows = [_row(judgement) for judgement in judgements]
        write_json(output, {"schema": "optshape/design-scores/1", "sensor": model.name, "shapes": rows})
    if plot is not None:
        from optshape_graph.viz.design import plot_comparison
        from optshape_graph.viz.style import save_figure

        save_figure(plot_comparison(judgements), plot)


@command.command(epilog=example("optshape design export board.yaml --format pdf --paper a3 --markers 15 -o board.pdf"))
@click.argument("shape")
@click.option("--format", "suffix", type=click.Choice(["svg", "dxf", "pdf"]), default="pdf", show_default=True)
@click.option("--paper", type=PAPERS, help="Spread SVG or PDF over sheets.  [default: one large sheet]")
@click.option("--orientation", type=click.Choice(["auto", "portrait", "landscape"]), default="auto", show_default=True,
              help="Of the sheets; auto: whichever needs fewer.")  # fmt: skip
@click.option("--markers", "marker_inset", type=Number(0.0, 1000.0), default=0.0, metavar="MM",
              help="Mark where motion-capture markers go: this far in from each corner.")  # fmt: skip
@click.option("--holes", nargs=2, type=Number(0.0, 1000.0), default=(0.0, 30.0), metavar="MM MM",
              help="Diameter of a hole at each corner, and how far in from it.")  # fmt: skip
@click.option("-o", "--output", type=FILE, help="File to write.  [default: SHAPE.FORMAT]")
@force_option
def export(
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

    A chessboard, tags, or both (ChArUco) are drawn black, and nothing over them. Several sheets come with a plan of
    them. The parts are listed.

    The drawing is the mirror image of the vertex list, which is given as seen from behind. The target file that
    everything else reads is written beside it, unless it is there. A drawing that is there is written over only with
    --force.
    """
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.design.drawing import Workshop, draw
    from optshape_graph.design.formats import export as write
    from optshape_graph.design.formats import files_of
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
    for written in write(drawing, path, sheet, orientation, parts):
        say(f"wrote {written}")
    say("parts:")
    for part in parts:
        say(f"  {part}")
    if not description.exists():
        save_target(description, target)
        say(f"wrote {description}")


@command.command(epilog=example("optshape design study --shapes 10 --sensor vlp32c --workers 2 -o study"))
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
def study(
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

    new_figure()  # whether there is matplotlib: better known before the study than after it
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


def _show(judgements: list[Judgement]) -> None:
    from optshape_graph.cli.console import print_table

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
    from math import degrees, isfinite

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
