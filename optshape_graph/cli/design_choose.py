"""`optshape design choose` and `measured`: which target does the job, and the one that came out of the workshop."""

from __future__ import annotations

from math import degrees, radians
from pathlib import Path
from typing import TYPE_CHECKING

import click

from optshape_graph.cli.console import print_table, say
from optshape_graph.cli.html_report import conclude, report_option
from optshape_graph.cli.options import DISTANCE, FILE, JSON_FILE, POSITIVE, Number, example, force_option, seed_option

if TYPE_CHECKING:
    from optshape_graph.evaluation.choose import Choice, Trial


@click.command(
    epilog=example("optshape design choose --sensor os0-64 --range 8 --rotation 2 --translation 0.03 -o board.yaml")
)
@click.option("--sensor", required=True, help="Name or file.")
@click.option("--range", "metres", type=DISTANCE, required=True, help="Of the target from the sensor, m.")
@click.option("--rotation", type=Number(0.0, 90.0, open=True), required=True,
              help="Largest rotation error in 95 of 100 scans, deg.")  # fmt: skip
@click.option("--translation", type=Number(0.0, 10.0, open=True), required=True,
              help="Largest translation error in 95 of 100 scans, m.")  # fmt: skip
@click.option("--shape", "shapes", multiple=True, default=("pose-optimal",), show_default=True,
              help="Shape to choose from; several: the one that can be smallest.")  # fmt: skip
@seed_option("Of the simulated scans.")
@click.option("--json", "json_path", type=JSON_FILE, help="Write the numbers to this file.")
@click.option("-o", "--output", type=FILE, help="Write the target to this file, and its drawing beside it, as PDF.")
@report_option
@force_option
def choose(
    sensor: str,
    metres: float,
    rotation: float,
    translation: float,
    shapes: tuple[str, ...],
    seed: int,
    json_path: Path | None,
    output: Path | None,
    html: Path | None,
    force: bool,
) -> int:
    """Choose the smallest target that a sensor finds as exactly as asked, and say how to hang it.

    Sizes are tried in steps of 12 % until 95 of 100 simulated scans end ok with both errors within what was asked. The
    target hangs within 3 deg of the roll and 20 deg of facing the sensor, its height within 2 cm and 0.1 deg.
    """
    from optshape_graph.cli.console import progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.cli.plots import check_picture
    from optshape_graph.evaluation.choose import Wish, choose_target
    from optshape_graph.io.documents import write_json
    from optshape_graph.io.sensors import load_sensor
    from optshape_graph.io.targets import load_target

    if output is not None and output.suffix.lower() == ".pdf":
        raise click.UsageError(f"--output {output}: expected a target file, as board.yaml; its drawing is the PDF")
    outputs = Outputs([sensor, *shapes], force=force)
    outputs.file("--json", json_path, "design-choice")
    outputs.file("--output", output, "target")
    if output is not None:
        outputs.new("--output", output.with_suffix(".pdf"))
        check_picture(output.with_suffix(".pdf"))
    outputs.file("--report", html)
    wish = Wish(load_sensor(sensor), metres, radians(rotation), translation)
    with progress_bar("sizes") as progress:
        choice = choose_target(wish, [load_target(shape) for shape in shapes], seed=seed, progress=progress)
    _show(choice)
    if json_path is not None:
        write_json(json_path, choice.to_dict())
    if output is not None:
        _write(choice, output)
    conclude(choice.to_dict(), html)
    return 0


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
def measured(shape: str, lengths: tuple[str, ...], check_bar: float | None, output: Path, force: bool) -> None:
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
              help="At least: what a stray return cannot make up for.")  # fmt: skip
@click.option("--starts", type=click.IntRange(1, 1000), default=6, show_default=True, help="Random starts.")
@click.option("--placements", type=click.IntRange(4, 10_000), default=96, show_default=True,
              help="Of each sensor at each range.")  # fmt: skip
@seed_option("Of the starts.")
@click.option("-o", "--output", type=FILE, default=Path("target.yaml"), show_default=True, help="Target file to write.")
@force_option
def optimise_poses(
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

    What is minimised is the median and the 95th percentile of e_r and e_t of each sensor at each range, against those
    of the reference shape of the same area. Minutes.
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


def _show(choice: Choice) -> None:
    wish, chosen = choice.wish, choice.chosen
    rows = [_row(chosen, "does it")]
    for trial, nearer in choice.smaller:
        rows.append(_row(trial, f"does it up to {nearer:.1f} m"))
    print_table(
        f"{wish.sensor.name} at {wish.range:g} m: {degrees(wish.rotation):g} deg and {1e3 * wish.translation:g} mm in "
        "95 of 100 scans",
        ["target", "area m2", "width x height m", "bound deg", "deg", "bound mm", "mm", "ok / ambiguous / failed", ""],
        rows,
        "bound: the 95th percentile at the Cramer-Rao bound; beside it that of the simulated scans that are ok. "
        "A size that misses is left after a few scans.",
    )
    width = 1000.0 * float(chosen.target.polygon[:, 0].max() - chosen.target.polygon[:, 0].min())
    above = "above" if chosen.height >= 0 else "below"
    say(f"hang it with its origin (the cross of the drawing) {abs(chosen.height):.2f} m {above} the sensor, to 2 cm")
    say("turned as the drawing shows it, UP upwards, to 3 deg; facing the sensor to 20 deg")
    say(f"stand: behind the target, no wider than {width / 2:.0f} mm, nothing else within 0.5 m behind its edges")


def _row(trial: Trial, remark: str) -> list[str]:
    import numpy as np

    width, height = np.ptp(trial.target.polygon, axis=0)
    e_r, e_t = trial.quantile(trial.e_r), trial.quantile(trial.e_t)
    counts = " / ".join(str(trial.statuses.count(status)) for status in ("ok", "ambiguous", "failed"))
    return [
        trial.target.name,
        f"{trial.target.area:.3f}",
        f"{width:.2f} x {height:.2f}",
        f"{degrees(trial.bound_rotation):.2f}",
        "" if e_r is None else f"{degrees(e_r):.2f}",
        f"{1e3 * trial.bound_translation:.1f}",
        "" if e_t is None else f"{1e3 * e_t:.1f}",
        counts if trial.statuses else "",
        remark,
    ]


def _write(choice: Choice, output: Path) -> None:
    from dataclasses import replace

    from optshape_graph.design.drawing import draw
    from optshape_graph.design.formats import export
    from optshape_graph.io.targets import save_target

    target = replace(choice.chosen.target, name=output.stem)
    save_target(output, target)
    say(f"wrote {output}")
    for path in export(draw(target), output.with_suffix(".pdf")):
        say(f"wrote {path}")
