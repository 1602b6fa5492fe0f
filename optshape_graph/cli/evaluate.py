"""`optshape evaluate`: the group of evaluations."""

from __future__ import annotations

import click

from optshape_graph.cli.lazy import LazyGroup

COMMANDS = {
    "simulation": "optshape_graph.cli.evaluate_simulation",
    "mocap": "optshape_graph.cli.evaluate_mocap",
    "paper": "optshape_graph.cli.evaluate_paper",
}

HELP = {
    "simulation": "The paper's simulations, with as many draws as asked for, and Table I.",
    "mocap": "Recordings with motion capture, and Table II.",
    "paper": "The paper, figure by figure and table by table.",
}


@click.group(cls=LazyGroup, commands_at=COMMANDS, help_of=HELP)
def command() -> None:
    """Measure how good the estimates are, beside what the paper reports."""
