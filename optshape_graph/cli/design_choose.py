"""`optshape design choose`: the smallest target that does a job."""

from __future__ import annotations

from math import degrees, radians
from pathlib import Path
from typing import TYPE_CHECKING

import click

from optshape_graph.cli.console import print_table, say
from optshape_graph.cli.html_report import conclude, report_option
from optshape_graph.cli.options import DISTANCE, FILE, JSON_FILE, Number, example, force_option, seed_option

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
def command(
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

    Sizes are tried in steps of 12 % until 95 of 100 simulated scans are ok with both errors as small as asked. The
    target hangs within 3 deg of the roll and 20 deg of facing the sensor, its height within 2 cm and 0.1 deg.
    With 64 rings that takes some ten seconds.
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
    with progress_bar("scans") as progress:
        choice = choose_target(wish, [load_target(shape) for shape in shapes], seed=seed, progress=progress)
    _show(choice)
    if json_path is not None:
        write_json(json_path, choice.to_dict())
    if output is not None:
        _write(choice, output)
    conclude(choice.to_dict(), html)
    return 0


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
