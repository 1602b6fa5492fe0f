"""Runs of the commands that should go wrong well: what each may do is checked after it, whatever it was given.

Allowed are exit status 0, 2 and 3 (130 and 143 after a signal), one line for an error, files in the folder that was
asked for. Not allowed are tracebacks and "unexpected", a changed input, a file anywhere else, half a file, a process
left behind, and a control character on the terminal.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from optshape_graph.cli.main import main

ROOT = Path(__file__).resolve().parents[2]

MANY = int(os.environ.get("FAULTS", "1"))
"""How many times as much is tried as in `make test`."""

GOOD = {0, 2, 3}


@dataclass(frozen=True)
class Said:
    """How a run ended.

    Attributes:
        status: of the exit.
        out: standard output.
        err: standard error.
    """

    status: int
    out: str
    err: str


class Terminal(io.StringIO):
    """Standard output or error of a run in this process."""

    encoding = "utf-8"

    def reconfigure(self, **_: object) -> None:
        """Take what a real stream would."""


def run(arguments: Sequence[str], folder: Path) -> Said:
    """Run a command in this process, in a folder."""
    before = sys.argv, os.getcwd(), {number: signal.getsignal(number) for number in (2, 15, 1)}
    out, err = Terminal(), Terminal()
    status = 0
    try:
        sys.argv = ["optshape", *arguments]
        os.chdir(folder)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
    finally:
        sys.argv, place, handlers = before
        os.chdir(place)
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return Said(status, out.getvalue(), err.getvalue())


def problem_of(said: Said, allowed: set[int] = GOOD) -> str:
    """What is wrong with how a run ended; empty: nothing."""
    if said.status not in allowed:
        return f"exit status {said.status}: {said.err[-500:]}"
    if "Traceback" in said.err + said.out or "unexpected" in said.err:
        return f"a traceback or something unexpected: {said.err[-800:]}"
    if re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e]", said.out + said.err):
        return f"a control character: {said.out[-200:]!r} {said.err[-200:]!r}"
    if said.status == 2:
        last = said.err.strip().splitlines()[-1] if said.err.strip() else ""
        if not re.match(r"(optshape: error: |Error: ).", last):
            return f"no error in one line: {said.err[-300:]!r}"
    return ""


def snapshot(folder: Path) -> dict[str, str]:
    """Every file below a folder, with what is in it."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            found[str(path.relative_to(folder))] = f"-> {path.readlink()}"
        elif path.is_file():
            found[str(path.relative_to(folder))] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            found[str(path.relative_to(folder))] = "other"
    return found


def changed(before: dict[str, str], after: dict[str, str], allowed: tuple[str, ...]) -> list[str]:
    """Files that were changed, removed, or made outside the allowed folders; and what is half a file anywhere."""
    wrong = [name for name, content in before.items() if after.get(name) != content and not name.startswith(allowed)]
    wrong += [name for name in after if name not in before and not name.startswith(allowed)]
    return wrong + [name for name in after if name.endswith(".tmp")]


def command(*arguments: object) -> list[str]:
    """Command line of a process of its own."""
    return [sys.executable, "-m", "optshape_graph", *map(str, arguments)]


def environment(**more: str) -> dict[str, str]:
    """Environment of a process of its own."""
    return os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"} | more


def descendants(pid: int) -> list[int]:
    """Processes below a process."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [one for child in map(int, children) for one in (child, *descendants(child))]


@contextlib.contextmanager
def started(arguments: Sequence[object], folder: Path, **variables: str) -> Iterator[subprocess.Popen[str]]:
    """A command in a process of its own, which is ended with the block."""
    process = subprocess.Popen(
        command(*arguments), cwd=folder, env=environment(**variables), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def gone(pids: Sequence[int], seconds: float = 5.0) -> list[int]:
    """Processes of these that have not ended in time."""
    deadline = time.monotonic() + seconds
    while (left := [pid for pid in pids if running(pid)]) and time.monotonic() < deadline:
        time.sleep(0.02)
    return left


def running(pid: int) -> bool:
    """Whether a process runs, zombies apart."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


linux_only = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="processes are looked for in /proc")
