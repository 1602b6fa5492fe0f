"""The `optshape` command: finds the command's module by name, and turns errors into one line."""

from __future__ import annotations

import logging
import sys

import click

import optshape_graph
from optshape_graph.cli.lazy import LazyGroup

COMMANDS = {
    "info": "optshape_graph.cli.info",
    "estimate": "optshape_graph.cli.estimate",
    "detect": "optshape_graph.cli.detect",
    "calibrate": "optshape_graph.cli.calibrate",
    "design": "optshape_graph.cli.design",
    "simulate": "optshape_graph.cli.simulate",
    "extract": "optshape_graph.cli.extract",
    "map": "optshape_graph.cli.map",
    "evaluate": "optshape_graph.cli.evaluate",
    "view": "optshape_graph.cli.view",
    "demo": "optshape_graph.cli.demo",
    "doctor": "optshape_graph.cli.doctor",
    "completion": "optshape_graph.cli.completion",
}
"""Command name to the module that defines it as `command`; imported when it is called."""

HELP = {
    "info": "Say what a file is: form, fields, units, rings, times, topics, the sensor.",
    "estimate": "Estimate a target's pose in scans that hold its returns.",
    "detect": "Find targets in full scans, and tell them apart by shape.",
    "calibrate": "Calibrate a LiDAR to motion capture, or to a camera.",
    "design": "Design target shapes: find one, judge them, draw one at 1:1.",
    "simulate": "Simulate a scan of a target or a scene, with known truth.",
    "extract": "Cut a session out of a bag or a folder of clouds: scans, images, markers.",
    "map": "Map targets and a trajectory out of a bag, a folder of clouds or a session.",
    "evaluate": "Measure how good the estimates are, beside what the paper reports.",
    "view": "Show a scan or a result in space, in Rerun or Open3D.",
    "demo": "Calibrate a bundled session: a result and pictures, in seconds.",
    "doctor": "Look at the installation: versions, extras, a self-check, and what to do.",
    "completion": "Print the script that makes bash, zsh or fish complete commands.",
}
"""One line per command, so that `optshape --help` imports none of them."""

LONGEST_MESSAGE = 2000
"""Characters of an error: a file may have a word of a million."""


@click.group(
    cls=LazyGroup, commands_at=COMMANDS, help_of=HELP, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(optshape_graph.__version__, prog_name="optshape")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
def cli(debug: bool) -> None:
    """LiDAR targets as landmarks: certified poses with covariances, calibration, maps.

    Exit status: 0 all well; 1 unexpected; 2 bad usage or input; 3 some scans failed or are ambiguous
    (the results of the others are written).
    """
    logging.basicConfig(format="optshape: %(levelname)s: %(message)s", level=logging.WARNING)


def one_line(message: str) -> str:
    """Return a message, which may quote a file, without line breaks and whatever else a terminal would obey."""
    shown = message if len(message) <= LONGEST_MESSAGE else message[: LONGEST_MESSAGE - 3] + "..."
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)


def main() -> None:
    """Run the command line; every error is one line and a non-zero exit status."""
    debug = "--debug" in sys.argv
    try:
        code = cli(standalone_mode=False)
    except click.exceptions.Abort:
        click.echo("optshape: interrupted", err=True)
        sys.exit(130)
    except click.ClickException as error:
        error.show()
        sys.exit(2)
    except (optshape_graph.OptshapeError, OSError) as error:
        if debug:
            raise
        click.echo(f"optshape: error: {one_line(str(error))}", err=True)
        sys.exit(2)
    except Exception as error:
        if debug:
            raise
        said = one_line(str(error))
        click.echo(f"optshape: unexpected {type(error).__name__}: {said} (--debug shows where)", err=True)
        sys.exit(1)
    sys.exit(code if isinstance(code, int) else 0)
