"""Help costs no more than Python, click and NumPy: nothing heavy is imported for it."""

import subprocess
import sys

import pytest

from optshape_graph.cli.main import COMMANDS, HELP
from tests.test_house import HEAVY

SCRIPT = """
import sys
from click.testing import CliRunner
from optshape_graph.cli.main import cli
for arguments in {arguments}:
    result = CliRunner().invoke(cli, [*arguments, "--help"])
    assert result.exit_code == 0, (arguments, result.output)
    loaded = [name for name in {heavy} if name in sys.modules]
    assert not loaded, (arguments, loaded)
"""


def test_help_imports_nothing_heavy():
    arguments = [[], *([name] for name in COMMANDS), ["calibrate", "mocap"], ["calibrate", "camera"],
                 ["evaluate", "simulation"], ["evaluate", "mocap"], ["design", "score"]]  # fmt: skip
    script = SCRIPT.format(arguments=arguments, heavy=[*HEAVY, "gtsam", "rich", "yaml"])
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_line(name):
    assert HELP[name].endswith(".")
