"""`optshape estimate`: a target's pose in scans that hold its returns."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.html_report import report_option
from optshape_graph.cli.options import (
    columns_option,
    example,
    force_option,
    journal_option,
    pool_options,
    sensor_option,
)
from optshape_graph.cli.plots import Draw, names_of, plot_option

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from optshape_graph.pose import PoseEstimate
    from optshape_graph.runs.workers import Pool
    from optshape_graph.scan import Scan

BYTES = 12_000
"""Rough size of a scan's entry in the document and its line in the journal, for which the disk must have room."""


@click.command(
    epilog=example(
        "optshape estimate returns.pcd --target board.yaml --sensor vlp32c --json poses.json --plot pictures"
    )
)
@click.argument("scans", nargs=-1, required=True, metavar="SCAN...")
@click.option("--target", required=True, help="Built-in name, NAME@AREA in m2, or target file.")
@sensor_option
@columns_option
@click.option("--method", type=click.Choice(["global", "paper"]), default="global", show_default=True,
              help="'paper' is the published alternation, for comparison.")  # fmt: skip
@click.option("--backend", type=click.Choice(["closed-form", "clarabel", "cvxpy"]), default="closed-form",
              show_default=True, help="What solves the relaxation behind the certificate.")  # fmt: skip
@journal_option
@pool_options
@force_option
@report_option
@plot_option("for every scan the fit, edges, residuals and vertices, and the runner-up where that is not ruled out")
def command(
    scans: tuple[str, ...],
    target: str,
    sensor: str | None,
    columns: tuple[str, ...] | None,
    method: str,
    backend: str,
    json_path: Path | None,
    pool: Pool | None,
    force: bool,
    html: Path | None,
    plots: Path | None,
) -> int:
    """Estimate a target's pose in each SCAN, which holds the target's returns and no others.

    `optshape info` shows what a cloud of any form holds.

    A SCAN is a file, a folder of clouds, a pattern in quotes ('drive/*.pcd'), or @LIST: a text file with a name on each
    line.

    Exit status 3: some scans failed, or are doubtful or ambiguous; the results of the others are written.
    """
    from optshape_graph.cli.inputs import scan_paths, sensor_of
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.cli.report import Table, run_over
    from optshape_graph.io import load_target
    from optshape_graph.pose.files import EstimateFiles

    paths = scan_paths(scans)
    outputs = Outputs([*scans, *paths, target, sensor], force=force)
    outputs.file("--json", json_path, "estimate", bytes_needed=BYTES * len(paths))
    outputs.file("--report", html)
    outputs.folder("--plot", plots)
    template, model = load_target(target), sensor_of(sensor, paths, columns)
    draw = Draw(plots, names_of(paths), figures) if plots else None
    estimate = EstimateFiles(template, model, method, backend, columns, draw)  # type: ignore[arg-type]  # click checked them
    table = Table(
        f"{template.name}: T_lidar_target",
        ["scan", "status", "x [m]", "y [m]", "z [m]", "± mm", "± deg", "cert.", "margin", "fit", "returns"],
        rows,
        "±: largest standard deviation of position and rotation. cert.: globally optimal. "
        "margin: log likelihood to the best different pose. "
        "fit: chi-square per degree of freedom of plane / edges, or what makes the pose doubtful.",
    )
    return run_over(estimate, paths, table, "estimate", output=json_path, html=html, plots=plots, pool=pool)


def figures(name: str, scan: Scan, estimate: PoseEstimate) -> dict[str, Figure]:
    """Return the figures of an estimate by name."""
    from optshape_graph.viz.pose import plot_estimate

    return {f"{name}_{kind}": figure for kind, figure in plot_estimate(scan, estimate).items()}


def rows(entry: dict[str, Any], status: str) -> list[list[str]]:
    """Return the row of an entry of the document."""
    import numpy as np

    name = Path(entry["scan"]).name
    if entry["certificate"] is None:
        return [[name, "failed", *[""] * 9]]
    if entry["T_lidar_target"] is None:
        return [[name, "failed", *[""] * 8, str(entry["n_returns"])]]
    sd = np.sqrt(np.diag(entry["covariance"]))
    margin = entry["ambiguity"]["margin"]
    return [
        [
            name,
            entry["status"],
            *(f"{line[3]:.3f}" for line in entry["T_lidar_target"][:3]),
            f"{1e3 * sd[3:].max():.1f}",
            f"{np.degrees(sd[:3].max()):.2f}",
            "yes" if entry["certificate"]["certified"] else "no",
            "" if margin is None else f"{margin:.0f}" if margin < 999.5 else ">999",
            entry["fit"]["summary"],
            str(entry["n_returns"]),
        ]
    ]
