"""Signals: one line and an end, whatever the process is doing when they come."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

RUN = """
import hashlib, sys
from optshape_graph.cli import main as command_line
from optshape_graph.runs.interruption import going_on

def native(**_):  # neither interrupted nor seen by Python for minutes
    with going_on(lambda: "3 of 5 files are done"):
        print("begun", flush=True)
        hashlib.pbkdf2_hmac("sha256", b"a", b"b", 10**9)

def swallowed(**_):  # raised where nothing can be
    class Thing:
        def __del__(self):
            print("begun", flush=True)
            while True:
                pass
    with going_on(lambda: "3 of 5 files are done"):
        thing = Thing()
        del thing
        while True:
            pass

def converted(**_):  # as native code that is passed makes another error of it
    try:
        with going_on(lambda: "3 of 5 files are done"):
            print("begun", flush=True)
            while True:
                pass
    except BaseException as error:
        raise ImportError("initialization failed") from error

def ending(**_):  # and what is cleaned up takes long
    try:
        with going_on(lambda: "3 of 5 files are done"):
            print("begun", flush=True)
            while True:
                pass
    finally:
        while True:
            pass

command_line.cli = globals()[sys.argv.pop(1)]
command_line.main()
"""


@pytest.mark.parametrize("how", ["native", "swallowed", "converted", "ending"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_line_and_an_end(how: str, number: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", RUN, how], env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=-1, stderr=-1, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    time.sleep(0.1)
    begun = time.monotonic()
    process.send_signal(number)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 128 + number
    assert said == f"optshape: stopped by {number.name}: 3 of 5 files are done\n"
    assert time.monotonic() - begun < 10.0  # 1 s, and what other tests beside it cost


def test_a_second_signal_ends_at_once() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", RUN, "ending"],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=-1, stderr=-1, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.readline()
    for _ in range(2):
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=60)[1].startswith("optshape: stopped by SIGINT")
    assert process.returncode == 130


def test_ignored_signals_stay_ignored() -> None:
    """Under nohup, and for jobs in the background."""
    script = (
        "import os, signal\nfrom optshape_graph.runs.interruption import stop_on_signals\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\nstop_on_signals()\nos.kill(os.getpid(), signal.SIGHUP)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], env=os.environ | {"PYTHONPATH": str(ROOT)}, check=False)
    assert done.returncode == 0
