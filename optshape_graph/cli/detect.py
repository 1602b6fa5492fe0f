"""`optshape detect`: targets in full scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.plots import Pictures, names_of, plot_option

if TYPE_CHECKING:
    from optshape_graph.detection import Detection


@click.command()
@click.argument("scans", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="SCAN...")
@click.option("--target", "targets", required=True, multiple=True,
              help="Built-in name, NAME@AREA in m2, or target file; once for each target to look for.")  # fmt: skip
@click.option("--sensor", help="Built-in name or sensor file. Without it: rings from the cloud, noise of a centimetre.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write the results to this file.")
@plot_option("for every scan what was found in it, and the fit of every target found")
def command(
    scans: tuple[Path, ...], targets: tuple[str, ...], sensor: str | None, json_path: Path | None, plots: Path | None
) -> int:
    """Find targets in each SCAN (PCD, PLY, NPZ or CSV), a full revolution, and tell them apart by shape.

    `return_indices` in the JSON count the cloud's returns from 0, in its order, without points that are no returns
    (not finite, or at the origin); `doubtful_indices` are further returns that the pose rests on, at the target's rim
    or with much noise. What was looked at and is no target is listed with the reason.

    Exit status 3: some scans could not be used, or a target's shape or pose is ambiguous; the results of the others
    are written.
    """
    from optshape_graph.cli.console import print_table, progress_bar
    from optshape_graph.detection import detect_targets
    from optshape_graph.errors import InputError
    from optshape_graph.io import load_sensor, load_target, read_scan
    from optshape_graph.io.documents import write_json

    wanted = [load_target(target) for target in targets]
    model = load_sensor(sensor) if sensor else None
    entries: list[dict[str, Any]] = []
    rows: list[list[str]] = []
    reasons: list[str] = []
    unusable: list[InputError] = []
    pictures = Pictures(plots) if plots else None
    with progress_bar("detecting") as progress:
        for done, (path, name) in enumerate(zip(scans, names_of(scans), strict=True)):
            progress(done, len(scans))
            try:
                scan = read_scan(path, model)
                detections = detect_targets(scan, wanted)
            except InputError as error:
                unusable.append(error)
                reasons.append(str(error))
                rows.append([path.name, "failed", *[""] * 7])
                entries.append({"scan": str(path), "targets": [], "rejected": [], "error": str(error)})
                continue
            entries.append(detections.to_dict())
            rows += [_row(path, one) for one in detections.found]
            if pictures:
                from optshape_graph.viz.pose import plot_fit
                from optshape_graph.viz.scan import plot_detections

                pictures.save(name, plot_detections(scan, detections))
                for k, one in enumerate(detections.found):
                    pictures.save(f"{name}_{k}_{one.target.name}", plot_fit(scan, one.estimate))
            if not detections.found:
                rows.append([path.name, "none", *[""] * 6, f"{len(detections.rejected)} rejected"])
            reasons += [f"{path}: {one.status}: {one.reason}" for one in detections.found if one.reason]
    if len(unusable) == len(scans):
        raise unusable[0]
    if json_path:
        write_json(json_path, {"schema": "optshape/detect/1", "scans": entries})
    print_table(
        "T_lidar_target",
        ["scan", "target", "status", "x [m]", "y [m]", "z [m]", "score", "returns", "margin"],
        rows,
        "score: 0 to 1. margin: log likelihood to the next of the targets asked for, where one fits as well.",
    )
    if pictures:
        pictures.tell()
    for reason in reasons:
        click.echo(f"optshape: {reason}", err=True)
    return 3 if reasons else 0


def _row(path: Path, detection: Detection) -> list[str]:
    position = detection.estimate.T_lidar_target[:3, 3]
    return [
        path.name,
        detection.target.name,
        detection.status,
        *(f"{x:.3f}" for x in position),
        f"{detection.score:.2f}",
        str(len(detection.indices)),
        f"{detection.margin:.3g}" if detection.rival else "",
    ]
