"""`optshape calibrate mocap`: a LiDAR tied to motion capture, and its estimates compared with the markers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.options import outside_option
from optshape_graph.cli.plots import Pictures, plot_option

if TYPE_CHECKING:
    from optshape_graph.calibration.mocap.comparison import ScanError


@click.command()
@click.argument("session", type=click.Path(path_type=Path), metavar="SESSION.yaml")
@click.option("--estimate-scale", is_flag=True, help="Estimate the motion capture's scale too; else it is 1.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write the results to this file.")
@plot_option("errors of the scans, where the target stood, where the markers are")
@outside_option
def command(
    session: Path, estimate_scale: bool, json_path: Path | None, plots: Path | None, allow_outside: bool = False
) -> int:
    """Calibrate T_lidar_mocap and the marker layout of a session, and compare the estimates with the markers.

    Errors are leave-one-out: each scan is compared in a frame fitted to the other scans. Exit status 3: some scans took
    no part; the results of the others are written.
    """
    from optshape_graph.calibration.mocap.calibrate import calibrate_mocap
    from optshape_graph.calibration.mocap.comparison import mean_error
    from optshape_graph.calibration.mocap.session import load_mocap_scans
    from optshape_graph.cli.console import print_table, print_transform, progress_bar
    from optshape_graph.io import load_session
    from optshape_graph.io.documents import write_json

    with progress_bar("estimating") as progress:
        scans, left_out = load_mocap_scans(load_session(session, allow_outside=allow_outside), progress)
    for item in left_out:
        click.echo(f"optshape: left out {item.scan}: {item.reason}", err=True)
    result = calibrate_mocap(scans, estimate_scale=estimate_scale)
    document: dict[str, Any] = {
        "schema": "optshape/mocap/1",
        "protocol": "leave-one-out",
        "T_lidar_mocap": result.T_lidar_mocap.tolist(),
        "covariance": result.covariance.tolist(),
        "marker_layout": result.marker_layout.tolist(),
        "scans": [
            {**_entry(error), "T_lidar_target": T}
            for error, T in zip(result.leave_one_out, result.T_lidar_target, strict=True)
        ],
        "mean": _numbers(mean_error(result.leave_one_out)),
        "in_sample": {
            "scans": [_entry(error) for error in result.in_sample],
            "mean": _numbers(mean_error(result.in_sample)),
        },
        "T_mocap_lidar": result.T_mocap_lidar.tolist(),
        "covariance_mocap_lidar": result.covariance_mocap_lidar.tolist(),
        "scale": result.scale,
        "scale_sigma": result.scale_sigma,
        "scatter": result.scatter,
        "left_out": [{"scan": item.scan, "reason": item.reason} for item in left_out],
    }
    if json_path:
        write_json(json_path, document)
    _print_errors(print_table, result.leave_one_out, result.in_sample)
    if estimate_scale:
        click.echo(f"scale of the motion capture: {result.scale:.4f} +- {result.scale_sigma:.4f}\n")
    print_transform(
        "T_lidar_mocap", "motion-capture points into the LiDAR frame", result.T_lidar_mocap, result.covariance
    )
    print_transform(
        "T_mocap_lidar", "LiDAR points into the motion-capture frame", result.T_mocap_lidar,
        result.covariance_mocap_lidar,
    )  # fmt: skip
    if plots:
        from optshape_graph.viz.mocap import plot_calibration_errors, plot_marker_layout, plot_placements

        pictures = Pictures(plots)
        pictures.save("errors", plot_calibration_errors(result))
        pictures.save("placements", plot_placements(scans, result))
        pictures.save("markers", plot_marker_layout(scans[0].estimate.target, result))
        pictures.tell()
    return 3 if left_out else 0


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


def _entry(error: ScanError) -> dict[str, Any]:
    return {"scan": error.scan, **_numbers(error)}


def _numbers(error: ScanError) -> dict[str, float]:
    return {"rmse_m": error.rmse_m, "e_t_m": error.e_t_m, "e_r_deg": error.e_r_deg}
