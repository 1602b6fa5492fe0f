"""`optshape detect`: targets in full scans."""

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

    from optshape_graph.detection import Detections
    from optshape_graph.runs.workers import Pool
    from optshape_graph.scan import Scan

BYTES = 60_000
"""Rough size of a scan's entry in the document and its line in the journal, for which the disk must have room."""

MOST_REJECTED = 3
"""Surfaces that are shown for a scan without targets: those that passed the most tests."""


@click.command(
    epilog=example(
        "optshape detect 'scans/*.pcd' --target paper@0.5 --target board.yaml --sensor os1-64 --json found.json"
    )
)
@click.argument("scans", nargs=-1, required=True, metavar="SCAN...")
@click.option("--target", "targets", required=True, multiple=True,
              help="Built-in name, NAME@AREA in m2, or target file; once for each target to look for.")  # fmt: skip
@sensor_option
@columns_option
@journal_option
@pool_options
@force_option
@report_option
@plot_option("for every scan what was found in it, and the fit of every target found")
def command(
    scans: tuple[str, ...],
    targets: tuple[str, ...],
    sensor: str | None,
    columns: tuple[str, ...] | None,
    json_path: Path | None,
    pool: Pool | None,
    force: bool,
    html: Path | None,
    plots: Path | None,
) -> int:
    """Find targets in each SCAN, a full revolution, and tell them apart by shape.

    `optshape info` shows what a cloud of any form holds.

    A SCAN is a file, a folder of clouds, a pattern in quotes ('drive/*.pcd'), or @LIST: a text file with a name on each
    line.

    `return_indices` in the JSON count the cloud's returns from 0, in its order, without points that are not returns
    (not finite, or at the origin). `doubtful_indices` are further returns that the pose uses, at the target's rim or
    with much noise. Surfaces that are not targets are listed with the reason, the most target-like first.

    Exit status 3: some scans could not be used, or a target's shape or pose is ambiguous; the results of the others
    are written.
    """
    from optshape_graph.cli.inputs import scan_paths, sensor_of
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.cli.report import Table, run_over
    from optshape_graph.detection.files import DetectFiles
    from optshape_graph.io import load_target

    paths = scan_paths(scans)
    outputs = Outputs([*scans, *paths, *targets, sensor], force=force)
    outputs.file("--json", json_path, "detect", bytes_needed=BYTES * len(paths))
    outputs.file("--report", html)
    outputs.folder("--plot", plots)
    draw = Draw(plots, names_of(paths), figures) if plots else None
    detect = DetectFiles(tuple(map(load_target, targets)), sensor_of(sensor, paths, columns), columns, draw)
    table = Table(
        "T_lidar_target",
        ["scan", "target", "status", "x [m]", "y [m]", "z [m]", "score", "returns", "fit", "margin"],
        rows,
        "score: 0 to 1. fit: chi-square per degree of freedom of plane / edges, or what makes a pose doubtful, or "
        "the surface no target. margin: log likelihood to the next target asked for, where one fits as well.",
    )
    return run_over(detect, paths, table, "detect", output=json_path, html=html, plots=plots, pool=pool)


def figures(name: str, scan: Scan, detections: Detections) -> dict[str, Figure]:
    """Return figures by name: the scan with what was found in it, and the fit of every target."""
    from optshape_graph.viz.pose import plot_fit
    from optshape_graph.viz.scan import plot_detections

    fits = {f"{name}_{k}_{one.target.name}": plot_fit(scan, one.estimate) for k, one in enumerate(detections.found)}
    return {name: plot_detections(scan, detections), **fits}


def rows(entry: dict[str, Any], status: str) -> list[list[str]]:
    """Return the rows of an entry of the document: one for each target or, without any, for likely surfaces."""
    name = Path(entry["scan"]).name
    if "error" in entry:
        return [[name, "failed", *[""] * 8]]
    if not entry["targets"]:
        return [
            [name, "none", *[""] * 7, f"{len(entry['rejected'])} rejected"],
            *(
                [
                    "",
                    nearest["target"] or "",
                    "rejected",
                    *(f"{x:.3f}" for x in nearest["centre"]),
                    "",
                    str(nearest["returns"]),
                    nearest["reason"],
                    "",
                ]
                for nearest in entry["rejected"][:MOST_REJECTED]
            ),
        ]
    return [
        [
            name,
            found["target"],
            found["status"],
            *(f"{line[3]:.3f}" for line in found["T_lidar_target"][:3]),
            f"{found['score']:.2f}",
            str(len(found["return_indices"]) + len(found["doubtful_indices"])),
            found["fit"]["summary"],
            f"{found['margin']:.3g}" if found["rival"] else "",
        ]
        for found in entry["targets"]
    ]
