"""`optshape evaluate paper`: make the paper's figures and tables again."""

from __future__ import annotations

from pathlib import Path

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.options import FOLDER, example, force_option, outside_option, seed_option
from optshape_graph.cli.plots import picture_ending, plot_format_option, save_picture


@click.command(epilog=example("optshape evaluate paper --draws 5 --mocap recordings -o paper"))
@click.option(
    "--draws",
    type=click.IntRange(1, 10_000),
    default=5,
    show_default=True,
    help="Scans of a row of Table I, and of a cell of figure 10.",
)
@click.option("--mocap", type=click.Path(file_okay=False, exists=True, path_type=Path), metavar="DIR",
              help="Session folders with markers, for Table II.")  # fmt: skip
@plot_format_option
@seed_option("Of everything random.")
@outside_option
@force_option
@click.option("-o", "--output", type=FOLDER, default=Path("paper"), show_default=True, help="Folder to write to.")
def command(
    draws: int,
    mocap: Path | None,
    seed: int,
    allow_outside: bool,
    force: bool,
    output: Path,
) -> None:
    """Make the paper's figures and tables again as far as data allow, and say which can't be made and why.

    Tables I and II are printed with the paper's columns: as printed, then ours, RMSE [m] (percent of the distance),
    e_t [m], e_r [deg].
    """
    from optshape_graph.cli.console import print_table, progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.evaluation.mocap import evaluate_mocap, find_sessions
    from optshape_graph.evaluation.paper import NOT_REPRODUCED, columns_of, figure_10, table_1, table_2
    from optshape_graph.evaluation.published import TABLE_1, TABLE_2
    from optshape_graph.evaluation.tables import write_csv
    from optshape_graph.io.targets import load_target
    from optshape_graph.viz.evaluation import plot_sweep
    from optshape_graph.viz.paper import figures

    older = (output / "tasks").is_dir()  # an older run may be replaced
    made = [] if older else ["table1.csv", "table2.csv", *(path.name for path in output.glob("figure-*"))]
    Outputs(force=force).folder("--output", output, made, replace=False)
    target = load_target("paper")
    for name, figure in figures(target, seed).items():
        say(f"picture: {save_picture(output, name, figure, picture_ending())}")
    with progress_bar("figure 10") as progress:
        cells = figure_10(target, output / "charts", draws, seed, progress)
    say(f"picture: {save_picture(output, 'figure-10-charts', plot_sweep(cells), picture_ending())}")
    with progress_bar("Table I") as progress:
        rows = table_1(target, output / "tasks", draws, seed, progress)
    write_csv(output / "table1.csv", rows)
    columns = ["orientation", "distance [m]", "returns: paper / ours", "e_q [m]", "paper, as printed"]
    print_table(
        f"Table I: simulation, noise level 1, medians of {draws} scans",
        [*columns, "ours", "the paper's method, again"],
        columns_of(TABLE_1, rows, ("global", "paper")),
    )
    if mocap is None:
        say("Table II needs recordings with motion capture: --mocap DIR")
    else:
        with progress_bar("Table II") as progress:
            recorded, _ = evaluate_mocap(find_sessions(mocap, allow_outside=allow_outside), None, progress)
        write_csv(output / "table2.csv", recorded)
        print_table(
            "Table II: recordings, leave-one-out (the paper's on markers stretched by 3 %)",
            [*columns, "ours"],
            columns_of(TABLE_2, table_2(recorded), ("ours",)),
        )
    for number, why in NOT_REPRODUCED.items():
        say(f"figure {number}: not made: {why}")
