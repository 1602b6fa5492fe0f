"""`optshape calibrate rig`: calibrate any sensors that targets connect to one another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from optshape_graph.cli.calibrate import (
    conclude_calibration,
    crops_option,
    json_option,
    range_bias_option,
    session_argument,
)
from optshape_graph.cli.console import say, warn
from optshape_graph.cli.html_report import report_option
from optshape_graph.cli.options import example, force_option, outside_option
from optshape_graph.cli.plots import Pictures, plot_option

if TYPE_CHECKING:
    from optshape_graph.calibration.rig import RigCalibration


@click.command(epilog=example("optshape calibrate rig session.yaml --json rig.json --report rig.html --export rig"))
@session_argument
@json_option
@report_option
@plot_option("the rig, its frames with what is not known of them, and errors of the sightings")
@click.option(
    "--export",
    type=click.Path(path_type=Path),
    help="Write the rig to this folder for Kalibr, URDF, ROS 1 and 2, and Autoware.",
)
@crops_option
@range_bias_option(
    0.0,
    "Standard deviation of a range bias that all rings of a LiDAR have alike, metres, beside what its sensor file "
    "says of each ring's own.",
)
@force_option
@outside_option
def command(
    session: Path,
    allow_outside: bool,
    force: bool,
    json_path: Path | None,
    html: Path | None,
    plots: Path | None,
    export: Path | None,
    use_target_points: bool,
    range_bias_sigma: float,
) -> int:
    """Calibrate LiDARs, cameras and motion-capture bodies to one another, through targets; no initial guess is needed.

    Sensors need not overlap, as long as targets, or targets that stay while the platform moves, connect them. The
    errors of each LiDAR's rings are estimated, too. Exit status 3: sightings contradict the others, or the result is
    not to be trusted; it is written all the same, with the reasons.
    """
    from optshape_graph.calibration.exports import EXPORTS, kalibr_distortion, write_exports
    from optshape_graph.calibration.rig import calibrate_rig
    from optshape_graph.cli.console import progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.io import load_session
    from optshape_graph.io.documents import write_json
    from optshape_graph.runs.kept import keeping

    loaded = load_session(session, allow_outside=allow_outside)
    outputs = Outputs([session], force=force)
    outputs.file("--json", json_path, "rig")
    outputs.file("--report", html)
    outputs.folder("--plot", plots)
    outputs.folder("--export", export, EXPORTS, replace=False)
    if export:
        for camera in loaded.cameras.values():
            kalibr_distortion(camera)
    with progress_bar("images and scans") as progress, keeping(json_path) as kept:
        calibration = calibrate_rig(
            loaded,
            use_target_points=use_target_points,
            range_bias_sigma=range_bias_sigma,
            progress=progress,
            kept=kept,
        )
        if json_path:
            write_json(json_path, calibration.to_dict())
    _print(calibration)
    if export:
        for path in write_exports(export, calibration.mounted()):
            say(f"{EXPORTS[path.name]}: {path}")
    pictures = Pictures(plots) if plots else None
    if pictures:
        from optshape_graph.viz.rig import plot_rig, plot_rings, plot_sightings

        pictures.save("rig", plot_rig(calibration))
        pictures.save("sightings", plot_sightings(calibration))
        if any(sensor.rings for sensor in calibration.sensors):
            pictures.save("rings", plot_rings(calibration))
        pictures.tell()
    conclude_calibration(calibration, calibration.passed_over, html, pictures)
    return 0 if calibration.trusted and not calibration.contradicting else 3


def _print(calibration: RigCalibration) -> None:
    from optshape_graph.calibration.exports import static_transforms
    from optshape_graph.calibration.rig.result import means
    from optshape_graph.cli.console import print_table, print_transform
    from optshape_graph.se3 import inverse, inverse_covariance

    mean = means(calibration.sightings)
    rows = []
    for sensor in calibration.sensors:
        off = mean.get(sensor.name)
        numbers = ["", "", ""] if off is None else [
            f"{1e3 * off['centre_error_m']:.1f}", f"{off['turn_error_deg']:.2f}", f"{off['chi_square'] / 6:.2f}"
        ]  # fmt: skip
        rows.append([sensor.name, sensor.kind, str(sensor.sightings), *numbers])
    print_table(
        "Sensors; sightings, each placement predicted by the others",
        ["sensor", "kind", "sightings", "centre [mm]", "turn [deg]", "chi2 / 6"],
        rows,
        "means; chi2 / 6: squared distances in the stated covariances, 1 where they are right",
    )
    for sighting in calibration.sightings:
        if not sighting.used:
            warn(f"not used: '{sighting.sensor}' in {sighting.file}: {sighting.reason}")
    for a, b in calibration.pairs:
        T, covariance = calibration.transform(a, b)
        print_transform(f"T_{a}_{b}", f"where {b} is in {a}", T, covariance)
        print_transform(f"T_{b}_{a}", "its inverse", inverse(T), inverse_covariance(T, covariance))
        lines = static_transforms(a, b, T)
        for line in (lines["ros1"], lines["ros2"], f"URDF: {lines['urdf']}"):
            say(line)
        offset, sd = calibration.time_offset(a, b)
        if sd > 0:
            say(f"the clock of {b} is ahead of that of {a} by {1e3 * offset:+.2f} ms, sd {1e3 * sd:.2f}")
        say(f"worst direction: {calibration.directions(a, b)[0].text} (sd)")
    for text in calibration.unobservable:
        say(f"not observable: {text}")
    if calibration.next_placement is not None:
        say(calibration.next_placement.text)
