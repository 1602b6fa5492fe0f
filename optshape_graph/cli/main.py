"""The `optshape` command: finds the command's module by name, and turns errors into one line."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
from typing import NoReturn

import click

from optshape_graph._version import __version__
from optshape_graph.cli.lazy import LazyGroup
from optshape_graph.errors import OptshapeError
from optshape_graph.names import shown
from optshape_graph.runs.interruption import (
    Stopped,
    end_on_signals,
    is_first_to_report,
    stop_on_signals,
    stopped_before_errors,
    stopped_line,
)

COMMANDS = {
    "info": "optshape_graph.cli.info",
    "estimate": "optshape_graph.cli.estimate",
    "detect": "optshape_graph.cli.detect",
    "calibrate": "optshape_graph.cli.calibrate",
    "design": "optshape_graph.cli.design",
    "simulate": "optshape_graph.cli.simulate",
    "extract": "optshape_graph.cli.extract",
    "map": "optshape_graph.cli.map",
    "merge": "optshape_graph.cli.merge",
    "evaluate": "optshape_graph.cli.evaluate",
    "view": "optshape_graph.cli.view",
    "report": "optshape_graph.cli.html_report",
    "demo": "optshape_graph.cli.demo",
    "doctor": "optshape_graph.cli.doctor",
    "completion": "optshape_graph.cli.completion",
}
"""Command name to the module that defines it as `command`; imported when it is called."""

HELP = {
    "info": "Say what a file is: form, fields, units, rings, times, topics, the sensor.",
    "estimate": "Estimate a target's pose in scans that hold its returns.",
    "detect": "Find targets in full scans, and tell them apart by shape.",
    "calibrate": "Calibrate a LiDAR to motion capture or a camera, or a whole rig.",
    "design": "Design target shapes: find one, judge them, draw one at 1:1.",
    "simulate": "Simulate a scan of a target or a scene, with known truth.",
    "extract": "Cut a session out of a bag or a folder of clouds: scans, images, markers.",
    "map": "Map targets and a trajectory out of a bag, a folder of clouds or a session.",
    "merge": "Make one map of several that have landmarks in common.",
    "evaluate": "Measure how good the estimates are, beside what the paper reports.",
    "view": "Show a scan or a result in space, in Rerun or Open3D.",
    "report": "Write what a result means as one HTML file: verdict, numbers, pictures.",
    "demo": "Calibrate a bundled session: a result and pictures, in seconds.",
    "doctor": "Look at the installation: versions, extras, a self-check, and what to do.",
    "completion": "Print the script that makes bash, zsh or fish complete commands.",
}
"""One line per command, so that `optshape --help` imports none of them."""

LONGEST_MESSAGE = 2000
"""Characters that a message has at most: a file may have a word of a million."""


@click.group(
    cls=LazyGroup, commands_at=COMMANDS, help_of=HELP, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(__version__, prog_name="optshape")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
@click.option("--profile", is_flag=True, help="Print at the end where the time went, on standard error.")
@click.pass_context
def cli(ctx: click.Context, debug: bool, profile: bool) -> None:
    """LiDAR targets as landmarks: certified poses with covariances, calibration, maps.

    Exit status: 0 all well; 1 unexpected; 2 bad usage or input; 3 some scans failed, are doubtful or ambiguous
    (the results of the others are written).
    """
    handler = logging.StreamHandler()
    handler.setFormatter(OneLine("optshape: %(levelname)s: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    if profile:
        from optshape_graph.cli.profiling import profiled

        ctx.with_resource(profiled())


class OneLine(logging.Formatter):
    """Formats a log message as one line without control characters."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        return shown(super().format(record), LONGEST_MESSAGE)


def main() -> None:
    """Run the command line; every error is one line and a non-zero exit status."""
    debug = "--debug" in sys.argv
    open_streams()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # an ASCII terminal gets escapes of other characters
            stream.reconfigure(errors="backslashreplace")
    try:
        stop_on_signals()
        code = run(debug)
    except Stopped as stopped:
        if is_first_to_report():
            end(stopped_line(stopped.signal, stopped.advice), stopped.exit_status)
        sys.exit(stopped.exit_status)
    finally:
        end_on_signals()
    sys.exit(code)


def run(debug: bool) -> int:
    """Run the command, and return its exit status; exit with one line if it ends in an error."""
    try:
        with stopped_before_errors():
            code = cli(standalone_mode=False)
            sys.stdout.flush()
        return code if isinstance(code, int) else 0
    except (click.exceptions.Abort, KeyboardInterrupt):
        end(stopped_line(signal.SIGINT, ""), 130)
    except click.ClickException as error:
        said = error.format_message()
        if isinstance(error, click.UsageError) and error.ctx is not None:
            click.echo(f"{error.ctx.get_usage()}\nTry '{error.ctx.command_path} --help' for help.\n", err=True)
        click.echo(f"Error: {shown(said, LONGEST_MESSAGE)}", err=True)
        sys.exit(2)
    except (BrokenPipeError, SystemExit):  # click and rich exit for a broken pipe only
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the reader of the output has closed it
        sys.exit(0)
    except (OptshapeError, OSError) as error:
        if debug:
            show_traceback(error)
        end(f"optshape: error: {reason(error)}", 2)
    except MemoryError:
        end("optshape: error: not enough memory", 2)
    except Exception as error:
        if debug:
            show_traceback(error)
        end(f"optshape: unexpected {type(error).__name__}: {shown(error, LONGEST_MESSAGE)} (--debug shows where)", 1)


def open_streams() -> None:
    """Open standard streams that are closed to the null device: other files would take their numbers."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free: this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115  # for good


def end(message: str, status: int) -> NoReturn:
    """Print a message in one line, and exit."""
    with contextlib.suppress(OSError):
        click.echo(shown(message, LONGEST_MESSAGE), err=True)
    sys.exit(status)


def reason(error: Exception) -> str:
    """Return what went wrong; the system's errors begin with the file, as all others do."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def show_traceback(error: Exception) -> None:
    """Print a traceback line by line, without control characters."""
    import traceback

    for line in "".join(traceback.format_exception(error)).splitlines():
        click.echo(shown(line), err=True)
