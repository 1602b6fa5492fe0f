"""`optshape calibrate mocap`: calibrate a LiDAR to motion capture, and compare its estimates with the markers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.calibrate import conclude_calibration, json_option, session_argument
from optshape_graph.cli.console import say, warn
from optshape_graph.cli.html_report import report_option
from optshape_graph.cli.options import example, force_option, outside_option
from optshape_graph.cli.plots import Pictures, plot_option

if TYPE_CHECKING:
    from optshape_graph.calibration.mocap.comparison import ScanError


@click.command(
    epilog=example("optshape calibrate mocap session.yaml --json mocap.json --report mocap.html --plot pictures")
)
@session_argument
@click.option("--estimate-scale", is_flag=True, help="Estimate the motion capture's scale too; else it is 1.")
@json_option
@force_option
@report_option
@plot_option("errors of the scans, where the target stood, where the markers are")
@outside_option
def command(
    session: Path,
    estimate_scale: bool,
    json_path: Path | None,
    plots: Path | None,
    html: Path | None = None,
    force: bool = False,
    allow_outside: bool = False,
) -> int:
    """Calibrate T_lidar_mocap and the marker layout of a session, and compare the estimates with the markers.

    Errors are leave-one-out: each scan is compared in a frame fitted to the other scans. Exit status 3: some scans took
    no part, or the result is not to be trusted; it is written all the same, with the reasons.
    """
    from optshape_graph.calibration.mocap import calibrate_mocap
    from optshape_graph.cli.console import print_table, print_transform, progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.io import load_session
    from optshape_graph.io.documents import write_json
    from optshape_graph.runs.kept import keeping

    loaded = load_session(session, allow_outside=allow_outside)
    outputs = Outputs([session], force=force)
    outputs.file("--json", json_path, "mocap")
    outputs.file("--report", html)
    outputs.folder("--plot", plots)
    with progress_bar("estimating") as progress, keeping(json_path) as kept:
        result = calibrate_mocap(loaded, estimate_scale=estimate_scale, progress=progress, kept=kept)
        if json_path:
            write_json(json_path, result.to_dict())
    for item in result.left_out:
        warn(f"left out {item.scan}: {item.reason}")
    _print_errors(print_table, result.leave_one_out, result.in_sample)
    if result.scale_sigma:
        say(f"scale of the motion capture: {result.scale:.4f} +- {result.scale_sigma:.4f}")
        click.echo()
    print_transform(
        "T_lidar_mocap", "motion-capture points into the LiDAR frame", result.T_lidar_mocap, result.covariance
    )
    print_transform(
        "T_mocap_lidar", "LiDAR points into the motion-capture frame", result.T_mocap_lidar,
        result.covariance_mocap_lidar,
    )  # fmt: skip
    pictures = Pictures(plots) if plots else None
    if pictures:
        from optshape_graph.viz.mocap import plot_calibration_errors, plot_marker_layout, plot_placements

        pictures.save("errors", plot_calibration_errors(result))
        pictures.save("placements", plot_placements(result))
        pictures.save("markers", plot_marker_layout(result))
        pictures.tell()
    conclude_calibration(result, result.passed_over, html, pictures)
    return 0 if result.trusted and not result.left_out else 3


def _print_errors(print_table: Any, loo: Sequence[ScanError], inside: Sequence[ScanError]) -> None:
    from optshape_graph.calibration.mocap.comparison import mean_error

    rows = [
        [a.scan, *(f"{value:.4f}" for value in (a.rmse_m, a.e_t_m)), f"{a.e_r_deg:.2f}",
         *(f"{value:.4f}" for value in (b.rmse_m, b.e_t_m)), f"{b.e_r_deg:.2f}"]
        for a, b in zip([*loo, mean_error(loo)], [*inside, mean_error(inside)], strict=True)
    ]  # fmt: skip
    print_table(
        "LiDAR estimates against the markers",
        ["scan", "RMSE [m]", "e_t [m]", "e_r [deg]", "in-sample RMSE [m]", "e_t [m]", "e_r [deg]"],
        rows,
        "Leave-one-out: each scan in a frame fitted to the others. In-sample: in a frame fitted to all.",
    )
