"""`optshape calibrate`: the group of calibrations."""

from __future__ import annotations

import click

from optshape_graph.cli.lazy import LazyGroup

COMMANDS = {
    "mocap": "optshape_graph.cli.calibrate_mocap",
    "camera": "optshape_graph.cli.calibrate_camera",
    "sensor": "optshape_graph.cli.calibrate_sensor",
}

HELP = {
    "mocap": "A LiDAR and motion capture, from scans of a target with markers.",
    "camera": "LiDARs and cameras, from scans and images of targets.",
    "sensor": "A LiDAR's own rings, from boards that stand still.",
}


@click.group(cls=LazyGroup, commands_at=COMMANDS, help_of=HELP)
def command() -> None:
    """Calibrate a LiDAR to motion capture, to a camera, or its own rings."""
