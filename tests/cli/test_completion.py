"""`optshape completion`: scripts that the shells take, and completions that they get."""

import os
import shutil
import subprocess
import sys

import pytest
from click.testing import CliRunner

from optshape_graph.cli.completion import SHELLS
from optshape_graph.cli.main import COMMANDS, cli


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_calls_back(shell):
    result = CliRunner().invoke(cli, ["completion", shell], standalone_mode=False)
    assert result.exception is None
    assert f"_OPTSHAPE_COMPLETE={shell}_complete" in result.output
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=result.output, text=True, check=True)


def completions(line: str) -> set[str]:
    script = "import sys; sys.argv = ['optshape']; from optshape_graph.cli.main import main; main()"
    words = line.split(" ")
    environment = os.environ | {
        "_OPTSHAPE_COMPLETE": "bash_complete", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1),
    }  # fmt: skip
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    return {entry.split(",", 1)[1] for entry in done.stdout.split()}


def test_commands_subcommands_and_options_are_completed():
    assert completions("optshape ") == set(COMMANDS)
    assert completions("optshape calibrate ") == {"mocap", "camera", "rig", "sensor"}
    assert "--plot" in completions("optshape estimate --p")
    assert completions("optshape completion ") == set(SHELLS)


def test_another_shell_is_refused():
    result = CliRunner().invoke(cli, ["completion", "tcsh"], standalone_mode=False)
    assert "tcsh" in str(result.exception.format_message())
