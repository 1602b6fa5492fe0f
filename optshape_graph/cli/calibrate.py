"""`optshape calibrate`: the group of calibrations."""

from __future__ import annotations

import click

from optshape_graph.cli.lazy import LazyGroup

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
