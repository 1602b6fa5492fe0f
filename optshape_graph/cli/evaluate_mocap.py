"""`optshape evaluate mocap`: estimates on recordings against motion capture, beside the paper's Table II."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from optshape_graph.cli.console import say, warn
from optshape_graph.cli.html_report import conclude, report_option
from optshape_graph.cli.options import FILE, FOLDER, JSON_FILE, example, force_option, outside_option
from optshape_graph.cli.plots import Pictures, plot_option

OF = {"": "ours", "in_sample_": "in-sample", "reference_": "reference", "published_": "paper"}
"""Prefix of columns, and what the printed table calls them."""


@click.command(epilog=example("optshape evaluate mocap recordings -o evaluation"))
@click.argument("folder", type=FOLDER, metavar="DIR")
@click.option("--reference", type=FILE, metavar="FILE",
              help="Another method's estimates, to compare in the same way: JSON, 'session folder/scan' to an entry "
                   "with T_lidar_target_paper.")  # fmt: skip
@click.option("--json", "json_path", type=JSON_FILE, help="Write the results to this file.")
@click.option("-o", "--output", type=FOLDER, default=Path("evaluation"),
              show_default=True, help="Folder for the table.")  # fmt: skip
@report_option
@plot_option("errors of all scans")
@force_option
@outside_option
def command(
    folder: Path,
    reference: Path | None,
    json_path: Path | None,
    output: Path,
    html: Path | None,
    plots: Path | None,
    force: bool,
    allow_outside: bool,
) -> int:
    """Compare the estimates of several sessions with their markers.

    DIR holds session folders, each with a session.yaml. Errors are leave-one-out: each scan is compared in a frame
    fitted to the other scans of its session. Writes mocap.csv and mocap.parquet to the output folder. Exit status 3:
    some scans took no part; the results of the others are written.
    """
    from optshape_graph.cli.console import print_table, progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.evaluation.documents import mocap_document
    from optshape_graph.evaluation.mocap import (
        PROTOCOLS,
        evaluate_mocap,
        find_sessions,
        load_reference,
    )
    from optshape_graph.evaluation.tables import check_parquet, write_csv, write_parquet
    from optshape_graph.io.documents import write_json

    outputs = Outputs([reference, *folder.glob("*/*")], force=force)
    outputs.file("--json", json_path, "mocap-evaluation")
    older = _is_table(output / "mocap.csv")  # it may be replaced
    outputs.folder("--output", output, () if older else ["mocap.csv", "mocap.parquet"], replace=False)
    outputs.folder("--plot", plots)
    outputs.file("--report", html)
    check_parquet()
    output.mkdir(parents=True, exist_ok=True)
    sessions = find_sessions(folder, allow_outside=allow_outside)
    estimates = None if reference is None else load_reference(reference)
    with progress_bar("estimating") as progress:
        rows, left_out = evaluate_mocap(sessions, estimates, progress)
    for item in left_out:
        warn(f"left out {item.scan}: {item.reason}")
    write_csv(output / "mocap.csv", rows)
    write_parquet(output / "mocap.parquet", rows)
    document = mocap_document(rows, left_out)
    if json_path:
        write_json(json_path, document)
    shown = [prefix for prefix in PROTOCOLS if any(row[f"{prefix}rmse_m"] is not None for row in rows)]
    print_table(
        "Table II: estimates against the markers, RMSE [m] / e_t [m] / e_r [deg]",
        ["scan", "distance [m]", "returns", *(OF[prefix] for prefix in shown)],
        [
            *([f"{row['session']}/{row['scan']}", f"{row['distance_m']:.2f}", str(row["n_points"]),
               *(_errors(row, prefix) for prefix in shown)] for row in rows),
            ["mean", "", "", *(_errors(document[f"{prefix}mean"], "") for prefix in shown)],
        ],
        "ours, reference: leave-one-out, each scan in a frame fitted to the others of its session. in-sample: ours, in "
        "a frame fitted to all. paper: as printed, on markers stretched by 3 %, in a frame fitted to its estimates.",
    )  # fmt: skip
    say(f"{len(rows)} scans; table in {output}")
    pictures = Pictures(plots) if plots else None
    if pictures:
        from optshape_graph.viz.mocap import plot_table

        pictures.save("errors", plot_table(rows, {prefix: OF[prefix] for prefix in shown}))
        pictures.tell()
    conclude(document, html, pictures.paths if pictures else ())
    return 3 if left_out else 0


def _errors(row: Mapping[str, Any] | None, prefix: str) -> str:
    if row is None or row[f"{prefix}rmse_m"] is None:
        return "-"
    return f"{row[f'{prefix}rmse_m']:.3f} {row[f'{prefix}e_t_m']:.3f} {row[f'{prefix}e_r_deg']:.2f}"


def _is_table(path: Path) -> bool:
    """Return whether a file is an older table of this command."""
    try:
        with path.open("rb") as stream:
            return stream.readline(200).startswith(b"session,scan,")
    except OSError:
        return False
