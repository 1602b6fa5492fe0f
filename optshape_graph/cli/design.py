"""`optshape design`: the group of commands for target shapes."""

from __future__ import annotations

import click

from optshape_graph.cli.lazy import LazyGroup

COMMANDS = {
    "choose": "optshape_graph.cli.design_choose",
    "export": "optshape_graph.cli.design_export",
    "measured": "optshape_graph.cli.design_measured",
    "optimise": "optshape_graph.cli.design_optimise",
    "optimise-poses": "optshape_graph.cli.design_optimise_poses",
    "score": "optshape_graph.cli.design_score",
    "study": "optshape_graph.cli.design_study",
}

HELP = {
    "choose": "Choose the smallest target that a sensor finds as exactly as asked.",
    "export": "Draw a target at 1:1, for the workshop.",
    "measured": "Put the measured sides of a target back into its file.",
    "optimise": "Find the shape whose worst score is best: the paper's aim.",
    "optimise-poses": "Find the shape whose pose is known best, over sensors and ranges.",
    "score": "Judge shapes: score, symmetry, and the Cramer-Rao bound on the pose.",
    "study": "Ask whether a better score means a better pose.",
}


@click.group(cls=LazyGroup, commands_at=COMMANDS, help_of=HELP)
def command() -> None:
    """Design target shapes: find one, judge them, draw one at 1:1.

    A SHAPE is a built-in name (square, paper, pose-optimal, ...), NAME@AREA in m2, or a target file.
    """
