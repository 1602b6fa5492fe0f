"""`optshape estimate`: a target's pose in scans that hold its returns."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.plots import Pictures, names_of, plot_option

if TYPE_CHECKING:
    from optshape_graph.pose import PoseEstimate


@click.command()
@click.argument("scans", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="SCAN...")
@click.option("--target", required=True, help="Built-in name, NAME@AREA in m2, or target file.")
@click.option("--sensor", help="Built-in name or sensor file. Without it: rings from the cloud, noise of a centimetre.")
@click.option("--method", type=click.Choice(["global", "paper"]), default="global", show_default=True,
              help="'paper' is the published alternation, for comparison.")  # fmt: skip
@click.option("--backend", type=click.Choice(["closed-form", "clarabel", "cvxpy"]), default="closed-form",
              show_default=True, help="What solves the relaxation behind the certificate.")  # fmt: skip
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write the results to this file.")
@plot_option("for every scan the fit, edges, residuals and vertices, and the runner-up where ambiguous")
@click.pass_context
def command(
    ctx: click.Context,
    scans: tuple[Path, ...],
    target: str,
    sensor: str | None,
    method: str,
    backend: str,
    json_path: Path | None,
    plots: Path | None,
) -> int:
    """Estimate a target's pose in each SCAN (PCD, PLY, NPZ or CSV), which holds the target's returns and no others.

    Exit status 3: some scans failed or are ambiguous; the results of the others are written.
    """
    from optshape_graph.cli.console import print_table, progress_bar
    from optshape_graph.errors import EstimationError, InputError
    from optshape_graph.io import load_sensor, load_target, read_scan
    from optshape_graph.io.documents import write_json
    from optshape_graph.pose import estimate_pose

    template = load_target(target)
    model = load_sensor(sensor) if sensor else None
    entries: list[dict[str, Any]] = []
    rows: list[list[str]] = []
    reasons: list[str] = []
    unreadable: list[InputError] = []
    pictures = Pictures(plots) if plots else None
    with progress_bar("estimating") as progress:
        for done, (path, name) in enumerate(zip(scans, names_of(scans), strict=True)):
            progress(done, len(scans))
            try:
                scan = read_scan(path, model)
                estimate = estimate_pose(scan, template, method, backend)  # type: ignore[arg-type]  # click checked them
            except (InputError, EstimationError) as error:
                if isinstance(error, InputError):
                    unreadable.append(error)
                entries.append(_failed(path, template.name, str(error)))
                rows.append([path.name, "failed", *[""] * 8])
                reasons.append(f"{path}: {error}" if isinstance(error, EstimationError) else str(error))
                continue
            entries.append(_entry(path, estimate))
            rows.append(_row(path, estimate))
            if pictures:
                from optshape_graph.viz.pose import plot_estimate

                for kind, figure in plot_estimate(scan, estimate).items():
                    pictures.save(f"{name}_{kind}", figure)
            if estimate.reason:
                reasons.append(f"{path}: {estimate.status}: {estimate.reason}")
    if len(unreadable) == len(scans):
        raise unreadable[0]
    if json_path:
        write_json(json_path, {"schema": "optshape/estimate/1", "scans": entries})
    print_table(
        f"{template.name}: T_lidar_target",
        ["scan", "status", "x [m]", "y [m]", "z [m]", "± mm", "± deg", "cert.", "margin", "returns"],
        rows,
        "±: largest standard deviation of position and rotation. cert.: globally optimal. "
        "margin: log likelihood to the best different pose.",
    )
    if pictures:
        pictures.tell()
    for reason in reasons:
        click.echo(f"optshape: {reason}", err=True)
    return 0 if all(entry["status"] == "ok" for entry in entries) else 3


def _failed(path: Path, target: str, reason: str) -> dict[str, Any]:
    empty = dict.fromkeys(
        ["T_lidar_target", "covariance", "vertices", "certificate", "ambiguity", "equivalent_poses", "inset_rad",
         "labels", "edge_points", "n_returns"]
    )  # fmt: skip
    return {"scan": str(path), "target": target, "status": "failed", "reason": reason, **empty}


def _entry(path: Path, estimate: PoseEstimate) -> dict[str, Any]:
    usable = estimate.status != "failed"
    rival = estimate.ambiguity.T_lidar_target
    return {
        "scan": str(path),
        "target": estimate.target.name,
        "status": estimate.status,
        "reason": estimate.reason,
        "T_lidar_target": estimate.T_lidar_target.tolist() if usable else None,
        "covariance": estimate.covariance.tolist() if usable else None,
        "vertices": estimate.vertices.tolist() if usable else None,
        "certificate": {
            "certified": estimate.certificate.certified,
            "gap_m2": estimate.certificate.gap_m2,
            "second_eigenvalue": estimate.certificate.second_eigenvalue,
        },
        "ambiguity": {
            "margin": estimate.ambiguity.margin if rival is not None else None,
            "T_lidar_target": rival.tolist() if rival is not None else None,
        },
        "equivalent_poses": estimate.equivalent_poses.tolist() if usable else None,
        "inset_rad": estimate.inset_rad if len(estimate.labels) else None,
        "labels": estimate.labels.tolist(),
        "edge_points": estimate.edge_points.points.tolist(),
        "n_returns": estimate.n_returns,
    }


def _row(path: Path, estimate: PoseEstimate) -> list[str]:
    import numpy as np

    sd = np.sqrt(np.diag(estimate.covariance))
    t = estimate.T_lidar_target[:3, 3]
    margin = "" if estimate.ambiguity.T_lidar_target is None else f"{min(estimate.ambiguity.margin, 999):.0f}"
    usable = estimate.status != "failed"
    return [
        path.name,
        estimate.status,
        *(f"{value:.3f}" if usable else "" for value in t),
        f"{1e3 * sd[3:].max():.1f}",
        f"{np.degrees(sd[:3].max()):.2f}",
        "yes" if estimate.certificate.certified else "no",
        margin,
        str(estimate.n_returns),
    ]
