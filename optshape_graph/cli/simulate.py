"""`optshape simulate`: make a scan with known truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.options import ANGLE, DISTANCE, FILE, Number, example, force_option, seed_option
from optshape_graph.cli.plots import Pictures, plot_option

if TYPE_CHECKING:
    from optshape_graph._arrays import Floats
    from optshape_graph.sensor import SensorModel
    from optshape_graph.simulation import Motion, NoiseModel

NOISE_OPTIONS = {
    "range_noise": ("--range-noise", "METRES", 100.0, "Standard deviation of one range."),
    "azimuth_noise": ("--azimuth-noise-deg", "DEG", 45.0, "Standard deviation of one azimuth."),
    "elevation_noise": ("--elevation-noise-deg", "DEG", 45.0, "Standard deviation of one elevation."),
    "ring_bias": ("--ring-bias", "METRES", 100.0, "Standard deviation over rings of the range bias of a ring."),
    "elevation_error": ("--elevation-error-deg", "DEG", 5.0, "Standard deviation over rings of a ring's elevation."),
    "azimuth_error": ("--azimuth-error-deg", "DEG", 5.0, "Standard deviation over rings of a ring's azimuth."),
    "range_resolution": ("--range-resolution", "METRES", 100.0, "Step to which ranges are rounded."),
    "dropout": ("--dropout", "P", 1.0, "Share of the returns lost at normal incidence; more at grazing."),
    "hit_fraction": ("--hit-fraction", "P", 1.0, "Share of a beam that must lie on a target to return from it."),
    "edge_spread": ("--edge-spread", "RADII", 100.0, "How far from there the decision may fall, in beam radii."),
}
"""Parts of the noise: option, metavar, largest value and help of each."""


def noise_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that set single parts of the noise."""
    for part, (option, metavar, most, text) in reversed(NOISE_OPTIONS.items()):
        function = click.option(option, part, type=Number(0.0, most), metavar=metavar, help=text)(function)
    return function


@click.command(
    epilog=example("optshape simulate --target paper --sensor vlp32c --range 8 --rpy 20 30 30 --noise 1 -o scan.pcd")
)
@click.option("--target", "target_name", default="paper", show_default=True, help="Built-in name, NAME@AREA, or file.")
@click.option("--sensor", "sensor_name", default="vlp32c", show_default=True, help="Built-in name or file.")
@click.option("--range", "distance", type=DISTANCE, metavar="METRES", help="Distance of the target, along x.")
@click.option("--rpy", nargs=3, type=ANGLE, default=(0.0, 0.0, 0.0), metavar="R P Y", help="Degrees; R = Rx Ry Rz.")
@click.option("--scene", type=click.Path(path_type=Path), help="Scene file (optshape/scene/1) instead of one target.")
@click.option(
    "--noise",
    "level",
    type=click.Choice(["0", "1", "2", "3", "4", "sensor"]),
    default="0",
    show_default=True,
    help="0 to 4: the paper's levels; sensor: what the sensor's file says. The options below change parts of it.",
)
@click.option("--range-only", is_flag=True, help="Leave out the angular part of the noise level.")
@noise_options
@click.option("--random-phase", is_flag=True, help="Shift the azimuth grid by a random part of a step.")
@click.option("--spin-rate", type=Number(0.1, 1000.0), default=10.0, show_default=True, metavar="HZ",
              help="Revolutions per second; the azimuth step grows with it.")  # fmt: skip
@click.option("--remove-rings", metavar="N,N,...", help="Rings that return nothing, counted from the lowest.")
@click.option(
    "--remove-share", type=Number(0.0, 1.0), metavar="P", help="Share of the rings that return nothing, at random."
)
@click.option("--reference", is_flag=True, help="The paper's simulator with its quirks; --sensor does not apply.")
@seed_option("Of the noise.")
@click.option("-o", "--output", type=FILE, required=True, help="Cloud to write, ending in .pcd.")
@force_option
@plot_option("the scan, with the true outlines of the targets")
def command(
    target_name: str,
    sensor_name: str,
    distance: float | None,
    rpy: tuple[float, float, float],
    scene: Path | None,
    level: str,
    range_only: bool,
    random_phase: bool,
    spin_rate: float,
    remove_rings: str | None,
    remove_share: float | None,
    reference: bool,
    seed: int,
    output: Path,
    force: bool,
    plots: Path | None,
    **noise_parts: float | None,
) -> None:
    """Simulate one revolution; write the cloud, and the truth beside it.

    With --range: the returns on one target that faces the sensor, turned by --rpy, its vertex mean at the distance
    along x. With --scene: the returns of everything in the scene. The truth has the output's name, ending in .json:
    pose and vertices of every target in the LiDAR frame. An existing file is replaced only with --force.
    """
    import numpy as np

    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.io import load_sensor, load_target
    from optshape_graph.simulation import (
        Patch,
        Scene,
        load_scene,
        pose_from_rpy,
        random_rings,
        simulate,
        spinning_at,
        write_simulation,
    )
    from optshape_graph.simulation.reference import reference_pose, reference_sensor

    if (scene is None) == (distance is None):
        raise click.UsageError("give either --range (one target) or --scene")
    if reference and scene is not None:
        raise click.UsageError("--reference places one target: it goes with --range, not with --scene")
    if output.suffix.lower() != ".pcd":
        raise click.BadParameter(f"expected a name ending in .pcd, found '{output}'", param_hint="--output")
    outputs = Outputs([scene, target_name, sensor_name], force=force)
    outputs.new("--output", output)
    outputs.new("--output (truth)", output.with_suffix(".json"))
    outputs.folder("--plot", plots)
    sensor = spinning_at(reference_sensor() if reference else load_sensor(sensor_name), spin_rate)
    noise = _noise(sensor, level, range_only, random_phase, noise_parts)

    placement: Floats | Motion = np.eye(4)
    if scene is not None:
        world, placement = load_scene(scene)
    elif distance is not None:
        target, angles = load_target(target_name), np.radians(rpy)
        pose = reference_pose(target, distance, angles) if reference else pose_from_rpy([distance, 0.0, 0.0], angles)
        world = Scene((Patch(target, pose),))
    rng = np.random.default_rng(seed)
    result = simulate(world, sensor, placement, noise=noise, rng=rng, spin_rate=spin_rate, name=str(output))
    left_out = _ring_numbers(remove_rings, sensor.n_rings)
    if remove_share is not None:
        left_out = sorted({*left_out, *random_rings(result.scan, remove_share, rng).tolist()})
    result = result.without_rings(left_out)
    truth = write_simulation(output, result, noise, seed, left_out)
    say(f"{output}: {len(result.scan)} returns; truth: {truth}")
    if plots:
        from optshape_graph.viz.scan import plot_simulation

        pictures = Pictures(plots)
        pictures.save(output.stem, plot_simulation(result))
        pictures.tell()


def _noise(
    sensor: SensorModel, level: str, range_only: bool, random_phase: bool, parts: dict[str, float | None]
) -> NoiseModel:
    """Return the noise level, with the given parts in place of its own."""
    import numpy as np

    from optshape_graph.simulation import NoiseModel

    noise = NoiseModel.of(sensor) if level == "sensor" else NoiseModel.level(int(level), range_only)
    given: dict[str, Any] = {
        part: float(np.radians(value)) if NOISE_OPTIONS[part][1] == "DEG" else value
        for part, value in parts.items()
        if value is not None
    }
    return replace(noise, random_phase=noise.random_phase or random_phase, **given)


def _ring_numbers(text: str | None, n_rings: int) -> list[int]:
    try:
        rings = [int(number) for number in text.split(",")] if text else []
    except ValueError:
        raise click.UsageError(f"--remove-rings: expected numbers separated by commas, found '{text}'") from None
    if any(not 0 <= ring < n_rings for ring in rings):
        raise click.UsageError(f"--remove-rings: rings are numbered 0 to {n_rings - 1}, found '{text}'")
    return rings
