"""`optshape evaluate simulation`: the paper's sweep, with as many draws as asked for."""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.html_report import conclude, report_option
from optshape_graph.cli.options import (
    ANGLE,
    DISTANCE,
    FOLDER,
    JSON_FILE,
    Number,
    example,
    force_option,
    pool_options,
    seed_option,
)
from optshape_graph.cli.plots import picture_ending, plot_format_option, save_picture

if TYPE_CHECKING:
    from optshape_graph.evaluation.harness import Row
    from optshape_graph.evaluation.simulation import Removal, SimulationSweep
    from optshape_graph.runs.workers import Pool

TABLES = ("scans.csv", "scans.parquet", "cells.csv", "groups.csv", "consistency.csv", "table1.csv")
PICTURES = ("errors.png", "errors.svg", "errors.pdf")
"""Pictures that are written to the output folder."""


@click.command(epilog=example("optshape evaluate simulation --seeds 20 --workers 4 -o sweep"))
@click.option("--target", "target_name", default="paper", show_default=True, help="Built-in name, NAME@AREA, or file.")
@click.option(
    "--sensor", "sensor_name", help="Built-in name or file.  [default: the paper's simulator, quirks included]"
)
@click.option("--method", "methods", multiple=True, type=click.Choice(["global", "paper"]), help="May be repeated.")
@click.option(
    "--range",
    "--distance",
    "distances",
    multiple=True,
    type=DISTANCE,
    help="Of the target, m; may be repeated.  [default: 2 to 40 m by 2 m]",
)
@click.option("--rpy", "angles", multiple=True, nargs=3, type=ANGLE, metavar="R P Y",
              help="Degrees, R = Rx Ry Rz; may be repeated.  [default: 0 0 0 and 20 30 30]")  # fmt: skip
@click.option("--noise", "levels", multiple=True, type=click.Choice(["0", "1", "2", "3", "4", "sensor"]),
              help="The paper's, or what the sensor's file says; may be repeated.  [default: 0, 1, 3]")  # fmt: skip
@click.option("--range-only", is_flag=True, help="Leave out the angular part of the noise levels.")
@click.option(
    "--seeds", "draws", type=click.IntRange(1, 1_000_000), default=20, show_default=True, help="Scans per cell."
)
@click.option("--jitter/--no-jitter", default=True, show_default=True,
              help="Move the true pose within an azimuth step and a ring gap.")  # fmt: skip
@click.option("--remove-share", type=Number(0.0, 0.999), default=0.0, show_default=True,
              help="Share of the rings to leave out.")  # fmt: skip
@click.option("--remove", "removal", type=click.Choice(["random", "lowest", "highest"]), default="random",
              show_default=True, help="Which rings those are.")  # fmt: skip
@seed_option("Of everything random.")
@pool_options
@click.option("--json", "json_path", type=JSON_FILE, help="Write the numbers of every cell to this file.")
@report_option
@plot_format_option
@force_option
@click.option("-o", "--output", type=FOLDER, default=Path("evaluation"),
              show_default=True, help="Folder for the results; a sweep that was stopped goes on there.")  # fmt: skip
def command(
    target_name: str,
    sensor_name: str | None,
    methods: tuple[str, ...],
    distances: tuple[float, ...],
    angles: tuple[tuple[float, float, float], ...],
    levels: tuple[str, ...],
    range_only: bool,
    draws: int,
    jitter: bool,
    remove_share: float,
    removal: str,
    seed: int,
    pool: Pool | None,
    json_path: Path | None,
    html: Path | None,
    force: bool,
    output: Path,
) -> None:
    """Rerun the paper's simulations: a sweep over distance, orientation and noise, with many draws.

    Writes to the output folder: scans.csv and scans.parquet (one row per scan and method), cells.csv and groups.csv
    (errors over the draws of a cell, and over all distances), consistency.csv (errors against covariances), table1.csv
    (the paper's Table I beside ours), and errors.png (the paper's line charts). Results do not depend on the number of
    workers.

    Columns named bound have the Cramer-Rao bound of that pose: the root mean square error of the best unbiased estimate
    that knows which ring ends on which edge. Errors can be smaller than the bound. Without noise, since it takes a
    ring's end for Gaussian with the variance of an azimuth step, step^2 / 12. With angular noise, since it takes each
    noisy azimuth by itself. They can be larger, since it does not allow for flipped poses.
    """
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.evaluation import SimulationSweep
    from optshape_graph.evaluation.tables import check_parquet
    from optshape_graph.io import load_sensor, load_target
    from optshape_graph.runs.interruption import going_on
    from optshape_graph.viz.style import new_figure

    outputs = Outputs([target_name, sensor_name], force=force)
    older = (output / "tasks" / "sweep.json").exists()  # its tables may be replaced
    outputs.folder("--output", output, () if older else (*TABLES, *PICTURES), replace=False)
    outputs.file("--json", json_path, "simulation-evaluation")
    outputs.file("--report", html)
    check_parquet()
    new_figure()  # fails without matplotlib, before the sweep rather than after it
    sweep = SimulationSweep(
        target=load_target(target_name),
        sensor=None if sensor_name is None else load_sensor(sensor_name),
        methods=methods or SimulationSweep.methods,
        distances=distances or SimulationSweep.distances,
        orientations=tuple(_orientation(rpy) for rpy in angles) or SimulationSweep.orientations,
        noise=levels or SimulationSweep.noise,
        range_only=range_only,
        draws=draws,
        jitter=jitter,
        removed_share=remove_share,
        removal=cast("Removal", removal),
        seed=seed,
    )
    with going_on(lambda: f"finished tasks are kept in {output}; the same command goes on there"):
        _run(sweep, pool, output, json_path, html)


def _run(sweep: SimulationSweep, pool: Pool | None, output: Path, json_path: Path | None, html: Path | None) -> None:
    """Run the sweep, write its tables and charts, and print its verdict."""
    from optshape_graph.cli.console import progress_bar
    from optshape_graph.evaluation import (
        beside_published,
        by_group,
        consistency,
        run_simulation,
        summarise,
        write_csv,
        write_parquet,
    )
    from optshape_graph.evaluation.documents import simulation_document
    from optshape_graph.io.documents import write_json
    from optshape_graph.viz.evaluation import plot_sweep

    with progress_bar("simulating and estimating") as progress:
        rows = run_simulation(sweep, output / "tasks", pool=pool, progress=progress)

    cell = ("method", "noise", "orientation", "range_m")
    cells = summarise(rows, cell)
    groups = summarise(rows, ("method", "noise", "orientation"))
    write_csv(output / "scans.csv", rows)
    write_parquet(output / "scans.parquet", rows)
    write_csv(output / "cells.csv", cells)
    write_csv(output / "groups.csv", groups)
    write_csv(output / "consistency.csv", by_group(rows, cell, consistency))
    printed_level = "1" if "1" in sweep.noise else sweep.noise[0]
    write_csv(output / "table1.csv", beside_published([row for row in cells if row["noise"] == printed_level]))
    picture = save_picture(output, "errors", plot_sweep(cells), picture_ending())
    document = simulation_document(sweep, rows)
    if json_path:
        write_json(json_path, document)
    _show(groups)
    say(f"{len(rows)} rows; tables and charts in {output}")
    conclude(document, html, [picture])


def _orientation(rpy_deg: tuple[float, float, float]) -> tuple[str, tuple[float, float, float]]:
    """Return name and angles of an orientation given in degrees."""
    roll, pitch, yaw = (radians(angle) for angle in rpy_deg)
    return " ".join(f"{angle:g}" for angle in rpy_deg), (roll, pitch, yaw)


def _show(groups: list[Row]) -> None:
    """Print the statuses of the estimates of each group, and their mean errors and 95th percentiles."""
    from optshape_graph.cli.console import print_table

    columns = ["method", "noise", "orientation", "ok", "doubtful", "ambiguous", "failed"]
    errors = [f"{name}_{part}" for name in ("rmse_m", "e_r_deg") for part in ("mean", "p95")]
    print_table(
        "Errors over all distances, of every estimate that there is",
        [*columns, "RMSE [m] mean", "95 %", "e_r [deg] mean", "95 %"],
        [
            [str(row[name]) for name in columns] + ["-" if row[name] is None else f"{row[name]:.3f}" for name in errors]
            for row in groups
        ],
    )
