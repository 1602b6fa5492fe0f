"""`optshape calibrate`: the group of calibrations, and what its commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.console import say_passed_over, warn
from optshape_graph.cli.html_report import conclude
from optshape_graph.cli.lazy import LazyGroup
from optshape_graph.cli.options import JSON_FILE, Number

if TYPE_CHECKING:
    from optshape_graph.calibration.verdict import Calibration
    from optshape_graph.cli.plots import Pictures
    from optshape_graph.io.passed_over import PassedOver

COMMANDS = {
    "mocap": "optshape_graph.cli.calibrate_mocap",
    "camera": "optshape_graph.cli.calibrate_camera",
    "sensor": "optshape_graph.cli.calibrate_sensor",
    "rig": "optshape_graph.cli.calibrate_rig",
}

HELP = {
    "mocap": "A LiDAR and motion capture, from scans of a target with markers.",
    "camera": "LiDARs and cameras, from scans and images of targets.",
    "sensor": "A LiDAR's own rings, from boards that stand still.",
    "rig": "Any LiDARs, cameras and motion-capture bodies that targets connect.",
}


@click.group(cls=LazyGroup, commands_at=COMMANDS, help_of=HELP)
def command() -> None:
    """Calibrate a LiDAR's own rings, a LiDAR to motion capture or to a camera, or any sensors to one another."""


def session_argument(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the argument SESSION.yaml to a command, which takes it as `session`."""
    return click.argument("session", type=click.Path(path_type=Path), metavar="SESSION.yaml")(function)


def json_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--json FILE` to a command that keeps finished steps; it takes the value as `json_path`."""
    return click.option(
        "--json", "json_path", type=JSON_FILE, help="Write the results to this file; until it is "
        "whole, what was found is kept in FILE.journal.",
    )(function)  # fmt: skip


def crops_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--use-target-points` to a command; it takes the value as `use_target_points`."""
    return click.option(
        "--use-target-points", is_flag=True, help="Take the targets' returns from the views' manual crops."
    )(function)


def range_bias_option(default: float, what: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the decorator that adds `--range-bias-sigma`.

    Args:
        default: metres.
        what: the help.
    """
    return click.option("--range-bias-sigma", type=Number(0.0, 10.0), default=default, show_default=True, help=what)


def conclude_calibration(
    calibration: Calibration, passed_over: PassedOver | None, html: Path | None, pictures: Pictures | None
) -> None:
    """Print what was not used, the warnings and the verdict, and write the report if one is asked for.

    Args:
        calibration: the result.
        passed_over: input that was not used.
        html: the report; None: none.
        pictures: that were drawn.
    """
    if passed_over is not None:
        say_passed_over(passed_over)
    for warning in calibration.warnings:
        warn(f"warning: {warning}")
    conclude(calibration.to_dict(), html, pictures.paths if pictures else ())
