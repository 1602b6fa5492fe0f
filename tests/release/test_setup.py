"""`.ci/setup`, which every target of the Makefile begins with: nothing twice, nothing over what is not its own."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

PYTHON = """#!/bin/sh
# Stands for a Python whose pip and venv say what they were asked for.
case "$*" in
  *ctypes.CDLL*) [ -z "$NO_LIBRARIES" ];;
  *"import ensurepip"*) [ -z "$NO_VENV" ];;
  "-m venv"*) echo "$*" >> "$LOG"; shift 2; [ "$1" != --clear ] || { shift; rm -rf "$1"; }
    mkdir -p "$1/bin"; touch "$1/pyvenv.cfg"; cp "$0" "$1/bin/python";;
  "-m pip"*) echo "$*" >> "$LOG"; [ -z "$OFFLINE" ];;
  *"import os, sys, optshape_graph"*) [ -e "$(dirname "$0")/../.optshape-plot" ] && [ -z "$MOVED" ];;
  *version_info*"< (3, 11)"*) [ -z "$OLD" ];;
  *version_info*) basename "$0" | grep -o '3[.][0-9]*' || echo 3.12;;
  --version) echo "Python 3.12.1";;
esac
"""

APT = '#!/bin/sh\necho "apt-get $*" >> "$LOG"\n[ -z "$OFFLINE" ]\n'


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout with stand-ins for python3 and apt-get first on the path."""
    (tmp_path / "checkout" / ".ci").mkdir(parents=True)
    shutil.copy(ROOT / ".ci" / "setup", tmp_path / "checkout" / ".ci" / "setup")
    (tmp_path / "checkout" / "pyproject.toml").touch()
    (tmp_path / "bin").mkdir()
    for name, text in (("python3", PYTHON), ("apt-get", APT), ("sudo", '#!/bin/sh\n"$@"\n')):
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    return tmp_path / "checkout"


def setup(checkout: Path, *arguments: str, code: int = 0, **variables: str) -> tuple[str, str]:
    """Run it; return what it said, and what it asked of python, pip and apt-get."""
    log = checkout.parent / "log"
    log.write_text("")
    environment = os.environ | {"PATH": f"{checkout.parent / 'bin'}:/usr/bin:/bin", "LOG": str(log)} | variables
    for name in ("python3.11", "python3.12", "python3.13", "python3.14"):
        if not (checkout.parent / "bin" / name).exists():
            (checkout.parent / "bin" / name).write_text("#!/bin/sh\nexit 127\n")
            (checkout.parent / "bin" / name).chmod(0o755)
    command = [str(checkout / ".ci" / "setup"), *(arguments or (".venv", "plot"))]
    result = subprocess.run(command, env=environment, cwd=checkout, capture_output=True, text=True)
    assert result.returncode == code, result.stdout + result.stderr
    return result.stdout + result.stderr, log.read_text()


def test_a_second_time_there_is_nothing_to_do(checkout: Path) -> None:
    said, asked = setup(checkout)
    assert "Installing optshape[plot] into .venv, with Python 3.12.1" in said
    assert "-m venv .venv" in asked
    assert "--editable .[plot]" in asked
    assert setup(checkout) == ("", "")


def test_a_change_of_pyproject_installs_again_in_the_same_environment(checkout: Path) -> None:
    setup(checkout)
    mark = checkout / ".venv" / ".optshape-plot"
    os.utime(checkout / "pyproject.toml", (mark.stat().st_mtime + 10,) * 2)
    _, asked = setup(checkout)
    assert "--editable .[plot]" in asked
    assert "-m venv" not in asked


def test_an_environment_of_another_checkout_is_made_anew(checkout: Path) -> None:
    setup(checkout)
    _, asked = setup(checkout, MOVED="1")
    assert "-m venv --clear .venv" in asked


def test_an_installation_that_failed_is_done_again(checkout: Path) -> None:
    setup(checkout, OFFLINE="1", code=1)
    assert not list((checkout / ".venv").glob(".optshape-*"))
    _, asked = setup(checkout)
    assert "--editable .[plot]" in asked


def test_a_folder_with_other_things_in_it_is_left_alone(checkout: Path) -> None:
    (checkout / "mine").mkdir()
    (checkout / "mine" / "thesis.tex").touch()
    said, asked = setup(checkout, "mine", "plot", code=1)
    assert "VENV=" in said
    assert asked == ""
    assert (checkout / "mine" / "thesis.tex").exists()


def test_someone_s_own_environment_is_added_to(checkout: Path) -> None:
    (checkout / "own" / "bin").mkdir(parents=True)
    (checkout / "own" / "pyvenv.cfg").touch()
    _, asked = setup(checkout, "own", "plot")
    assert "-m venv own" in asked
    assert "--clear" not in asked


def test_another_python_asked_for_is_another_environment(checkout: Path) -> None:
    setup(checkout)
    shutil.copy(checkout.parent / "bin" / "python3", checkout.parent / "bin" / "python3.13")
    _, asked = setup(checkout, ".venv", "plot", "python3.13")
    assert "-m venv --clear .venv" in asked


def test_an_old_python_is_named(checkout: Path) -> None:
    said, _ = setup(checkout, code=1, OLD="1")
    assert "needs Python 3.11 or newer; found Python 3.12.1" in said


def test_missing_libraries_and_venv_are_installed(checkout: Path) -> None:
    _, asked = setup(checkout, ".venv", "test", NO_LIBRARIES="1", NO_VENV="1")
    assert "libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1" in asked
    assert "python3.12-venv" in asked


def test_without_a_network_the_libraries_are_gone_without(checkout: Path) -> None:
    said, asked = setup(checkout, ".venv", "test", NO_LIBRARIES="1", OFFLINE="1", code=1)
    assert "Going on without libusb-1.0-0" in said
    assert "-m venv .venv" in asked  # and then pip says that there is no network


def test_the_demo_needs_no_system_libraries(checkout: Path) -> None:
    _, asked = setup(checkout, NO_LIBRARIES="1")
    assert "apt-get" not in asked
