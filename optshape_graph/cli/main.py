"""The `optshape` command: finds the command's module by name, and turns errors into one line."""

from __future__ import annotations

import importlib
import logging
import sys

import click

import optshape_graph

COMMANDS = {
    "estimate": "optshape_graph.cli.estimate",
}
"""Command name to the module that defines it as `command`; imported when it is called."""

HELP = {
    "estimate": "Estimate a target's pose in scans that hold its returns.",
}
"""One line per command, so that `optshape --help` imports none of them."""


class LazyGroup(click.Group):
    """A group whose commands are imported when they are run."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = importlib.import_module(COMMANDS[cmd_name]).command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, HELP[name]) for name in COMMANDS])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(optshape_graph.__version__, prog_name="optshape")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
def cli(debug: bool) -> None:
    """LiDAR targets as landmarks: certified poses with covariances, calibration, maps.

    Exit status: 0 all well; 1 unexpected; 2 bad usage or input; 3 some scans failed or are ambiguous
    (the results of the others are written).
    """
    logging.basicConfig(format="optshape: %(levelname)s: %(message)s", level=logging.WARNING)


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
        click.echo(f"optshape: error: {error}", err=True)
        sys.exit(2)
    except Exception as error:
        if debug:
            raise
        click.echo(f"optshape: unexpected {type(error).__name__}: {error} (--debug shows where)", err=True)
        sys.exit(1)
    sys.exit(code if isinstance(code, int) else 0)
