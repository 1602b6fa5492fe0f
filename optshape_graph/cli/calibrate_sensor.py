"""`optshape calibrate sensor`: calibrate a LiDAR's rings with boards that stand still in front of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from optshape_graph.cli.calibrate import conclude_calibration, crops_option, json_option
from optshape_graph.cli.console import say, warn
from optshape_graph.cli.html_report import report_option
from optshape_graph.cli.options import FILE, POSITIVE, example, force_option, outside_option
from optshape_graph.cli.plots import Pictures, plot_option

if TYPE_CHECKING:
    from optshape_graph.calibration.sensor import SensorCalibration
    from optshape_graph.io import Session


@click.command(epilog=example("optshape calibrate sensor boards.bag paper square@1 --sensor vlp32c -o mine.yaml"))
@click.argument("source", type=click.Path(path_type=Path), metavar="RECORDING|SESSION.yaml")
@click.argument("targets", nargs=-1, metavar="[TARGET]...")
@click.option("--also", multiple=True, type=click.Path(path_type=Path), metavar="RECORDING|SESSION.yaml",
              help="Another recording or session of the same sensor; may be given again.")  # fmt: skip
@click.option("--sensor", "sensor_name", help="Built-in name or sensor file: the prior.  [default: the session's]")
@click.option("--lidar", metavar="NAME", help="Which LiDAR of a session; not needed if there is only one.")
@click.option("--topic", metavar="TOPIC", help="Topic of a recording's scans; not needed if there is only one.")
@click.option("--distance", "measured", multiple=True, nargs=3, metavar="BOARD[/VERTEX] BOARD[/VERTEX] METRES[@SCAN]",
              help="Measured between boards that stood, in that scan or where they stood so far apart: fixes the mean "
              "range. Vertices count from 0.")  # fmt: skip
@click.option("--distance-sd", type=POSITIVE, default=0.002, show_default=True, metavar="METRES",
              help="Standard deviation of these distances.")  # fmt: skip
@crops_option
@click.option("-o", "--output", type=FILE, required=True, help="Sensor file to write, ending in .yaml.")
@json_option
@force_option
@report_option
@plot_option("how far each ring is off boards that took no part, before and after; and what was found of each ring")
@outside_option
def command(
    source: Path,
    targets: tuple[str, ...],
    also: tuple[Path, ...],
    sensor_name: str | None,
    lidar: str | None,
    topic: str | None,
    measured: tuple[tuple[str, str, str], ...],
    distance_sd: float,
    use_target_points: bool,
    output: Path,
    json_path: Path | None,
    plots: Path | None,
    html: Path | None = None,
    force: bool = False,
    allow_outside: bool = False,
) -> int:
    """Calibrate range, elevation and azimuth of each ring by boards that stand still for a second or two each.

    Placements that take no part judge the result. Exit status 3: they do not become likelier by it, and the sensor
    file is not written; or the result is not to be trusted.
    """
    from optshape_graph.calibration.sensor import Distance, calibrate_sensor
    from optshape_graph.cli.console import progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.errors import InputError
    from optshape_graph.io import load_sensor, load_session, load_target, save_sensor
    from optshape_graph.io.documents import write_json
    from optshape_graph.runs.kept import keeping

    inputs: list[Path] = []
    sources: list[Path | Session] = []
    for path in (source, *also):
        inputs.append(path)
        if path.suffix.lower() in (".yaml", ".yml", ".json"):
            session = load_session(path, allow_outside=allow_outside)
            sources.append(session)
        else:
            sources.append(path)
    files = [file for path in inputs for file in (path.rglob("*") if path.is_dir() else [path])]
    outputs = Outputs([*files, *targets, sensor_name], force=force)
    if output.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"-o {output}: expected a name ending in .yaml, since a sensor file is YAML")
    outputs.file("-o", output, "sensor")
    outputs.file("--json", json_path, "sensor-calibration")
    outputs.file("--report", html)
    outputs.folder("--plot", plots)
    distances = [Distance.parsed(a, b, metres, distance_sd) for a, b, metres in measured]
    with progress_bar("looking for boards") as progress, keeping(json_path) as kept:
        result = calibrate_sensor(
            sources,
            [load_target(name) for name in targets],
            load_sensor(sensor_name) if sensor_name else None,
            lidar=lidar,
            topic=topic,
            distances=distances,
            use_target_points=use_target_points,
            progress=progress,
            kept=kept,
        )
        if result.helps:
            save_sensor(output, result.sensor)
        if json_path:
            write_json(json_path, result.to_dict())
    for text in result.left_out:
        warn(f"left out {text}")
    _print(result)
    pictures = Pictures(plots) if plots else None
    if pictures:
        from optshape_graph.viz.sensor import plot_ring_deviations, plot_ring_residuals

        pictures.save("residuals", plot_ring_residuals(result))
        pictures.save("rings", plot_ring_deviations(result))
        pictures.tell()
    if not result.helps:
        warn(f"{output} was not written")
    conclude_calibration(result, None, html, pictures)
    return 0 if result.helps and result.trusted else 3


def _print(result: SensorCalibration) -> None:
    from optshape_graph.cli.console import print_table

    print_table(
        f"Rings of {result.sensor.name}",
        ["ring", "range [mm]", "sd", "elevation [deg]", "sd", "azimuth [deg]", "sd", "before [mm]", "after"],
        [
            [
                str(row["ring"]), f"{row['range_bias_mm']:+.1f}", f"{row['range_bias_sd_mm']:.1f}",
                f"{row['elevation_off_deg']:+.3f}", f"{row['elevation_sd_deg']:.3f}",
                f"{row['azimuth_off_deg']:+.3f}", f"{row['azimuth_sd_deg']:.3f}",
                *("-" if row[key] is None else f"{row[key]:.1f}" for key in ("before_mm", "after_mm")),
            ]
            for row in result.rows()
        ],
        "Before, after: how far a ring's returns are behind boards that took no part, root mean square.",
    )  # fmt: skip
    say(
        f"{len(result.placements)} placements; those left out become likelier by {result.gain:.1f} (logarithm). Range "
        f"noise {1e3 * result.sampling.range_noise:.1f} mm within rings, {1e3 * result.sensor.range_noise:.1f} in the "
        f"file; rings end {result.sensor.edge_offset:+.2f} +- "
        f"{result.sensor.edge_offset_sd:.2f} beam widths inside edges."
    )
