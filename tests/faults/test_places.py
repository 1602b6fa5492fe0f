"""Disks, terminals and names: what surrounds a run."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.faults.harness import MANY, Said, command, environment, problem_of, run, started
from tests.faults.inputs import HOSTILE, make_inputs

LINE = ["estimate", "4m.pcd", "8m.pcd", "--target", "target.yaml", "--sensor", "sensor.yaml"]

LIMITED = """
import resource, sys
limit = int(sys.argv.pop(1))
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
from optshape_graph.cli.main import main
main()
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("places") / "world"
    make_inputs(folder)
    return folder


def process(arguments: list[str], folder: Path, **variables: str) -> Said:
    """Run a command in a process of its own."""
    done = subprocess.run(
        command(*arguments), cwd=folder, env=environment(**variables), capture_output=True, timeout=120,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip
    return Said(done.returncode, done.stdout.decode(errors="replace"), done.stderr.decode(errors="replace"))


@pytest.mark.parametrize("limit", [0, 100, 6000, 20_000])
def test_a_disk_that_fills_up_keeps_what_is_finished(limit: int, world: Path) -> None:
    (world / "a.json").write_text('{"schema": "optshape/estimate/1", "scans": []}\n')
    old = (world / "a.json").read_bytes()
    unmeasured = {key: "" for key in os.environ if key.startswith("COV")}
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(limit), *LINE, "--json", "a.json"], cwd=world,
        env=environment(**unmeasured), capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    said = Said(done.returncode, done.stdout, done.stderr)
    assert problem_of(said) == ""
    if said.status == 2:
        assert "File too large" in said.err
        assert (world / "a.json").read_bytes() == old
    again = process([*LINE, "--json", "a.json"], world)
    assert again.status == 0, again.err
    assert len(json.loads((world / "a.json").read_text())["scans"]) == 2
    assert sorted(path.name for path in world.glob("a.json*")) == ["a.json"]
    assert not list(world.glob("*.tmp"))
    (world / "a.json").unlink()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 kB, read-only in the end."""
    place = tmp_path / "small"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)]
    if os.geteuid() or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=False)


def test_a_small_disk_is_seen_before_the_work(small_disk: Path, world: Path) -> None:
    many = ["4m.pcd"] * 10
    for options in (["--json", f"{small_disk}/a.json"], ["--plot", f"{small_disk}/pictures"]):
        said = run([*LINE, *many, *options], world)
        assert said.status == 2
        assert "bytes are free at" in said.err
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    said = run([*LINE, "--json", f"{small_disk}/a.json"], world)
    assert (said.status, "Read-only file system" in said.err) == (2, True)


TERMINALS = {
    "ASCII": {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"},
    "ASCII by the locale": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    "Latin 1": {"PYTHONIOENCODING": "latin-1"},
    "dumb": {"TERM": "dumb"},
    "narrow": {"COLUMNS": "1"},
    "wide": {"COLUMNS": "99999"},
    "no columns": {"COLUMNS": "x"},
    "colour": {"FORCE_COLOR": "1"},
    "no home": {"HOME": "/nonexistent", "XDG_CACHE_HOME": "/nonexistent"},
    "a locale that is none": {"LANG": "xx_XX.nonsense", "LC_ALL": "xx_XX.nonsense"},
    "another time": {"TZ": "Nowhere/Nothing"},
}


@pytest.mark.parametrize("name", TERMINALS)
def test_terminals(name: str, world: Path) -> None:
    said = process(LINE, world, **TERMINALS[name])
    assert said.status == 0, said.err
    if name != "colour":
        assert problem_of(said) == ""
    if "ASCII" in name:
        assert (said.out + said.err).isascii()
        assert "+-" in said.out
    if name not in ("narrow", "colour"):
        assert "4m.pcd" in said.out


def test_a_backend_that_is_none_is_said_before_the_work(world: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    said = process([*LINE, "--plot", str(tmp_path / "pictures")], world, MPLBACKEND="nonsense")
    assert said.status == 2
    assert "matplotlib does not start" in said.err


def test_a_reader_that_has_gone_is_no_error(world: Path) -> None:
    for arguments in (LINE, ["design", "score", "square", "paper", "--sensor", "vlp16"], ["--help"]):
        quoted = " ".join(command(*arguments))
        done = subprocess.run(
            ["bash", "-c", f"{quoted} | true; echo ${{PIPESTATUS[0]}}"], cwd=world, env=environment(),
            capture_output=True, text=True,
        )  # fmt: skip
        assert done.stdout.strip() in ("0", "141"), done.stderr
        assert "Traceback" not in done.stderr
        assert "Exception ignored" not in done.stderr


def test_closed_streams_are_no_error(world: Path) -> None:
    for redirection in (">&-", "2>&-", "<&-", ">&- 2>&- <&-"):
        quoted = " ".join(command(*LINE, "--json", "closed.json"))
        done = subprocess.run(
            ["bash", "-c", f"{quoted} {redirection}"], cwd=world, env=environment(), capture_output=True, text=True
        )
        assert done.returncode == 0, (redirection, done.stderr)
        assert "Traceback" not in done.stderr
        assert json.loads((world / "closed.json").read_text())["scans"][0]["status"] == "ok"


def test_output_that_cannot_be_written_is_one_line(world: Path) -> None:
    quoted = " ".join(command(*LINE))
    done = subprocess.run(
        ["bash", "-c", f"{quoted} > /dev/full"], cwd=world, env=environment(), capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "No space left on device" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


NAMES = [name for name in HOSTILE if name.strip() and len(name.encode()) < 250][:: 3 if MANY == 1 else 1]


@pytest.mark.parametrize("name", NAMES)
def test_names_of_targets_lead_nowhere(name: str, world: Path, tmp_path: Path) -> None:
    """In the drawing, the pictures, the terminal and HTML."""
    for library in ("matplotlib", "ezdxf"):
        pytest.importorskip(library)
    folder = tmp_path / "outer" / "inner"
    shutil.copytree(world, folder)
    text = (world / "target.yaml").read_text()
    (folder / "named.yaml").write_text(re.sub(r"(?m)^name:.*$", lambda _: f"name: {json.dumps(name)}", text))
    (folder / "out").mkdir()
    before = set(tmp_path.rglob("*"))
    for arguments in (
        ["design", "export", "../named.yaml", "--format", "svg"],
        ["estimate", "../4m.pcd", "--target", "../named.yaml", "--sensor", "../sensor.yaml", "--plot", "p"],
        ["--debug", "detect", "../room.pcd", "--target", "../named.yaml", "--sensor", "vlp16", "--json", "b.json"],
    ):  # fmt: skip
        assert problem_of(run(arguments, folder / "out")) == ""
    made = set(tmp_path.rglob("*")) - before
    assert all(path.is_relative_to(folder / "out") for path in made)
    [drawing] = (folder / "out").glob("*.svg")
    assert "<script" not in drawing.read_text()
    from xml.etree import ElementTree

    ElementTree.parse(drawing)


def test_names_in_notebooks_are_text() -> None:
    from dataclasses import replace

    from optshape_graph import estimate_pose, load_sensor, load_target, read_scan
    from optshape_graph.io import demo_folder

    scan = read_scan(demo_folder() / "4m.pcd", load_sensor("vlp32c"))
    for name in NAMES:
        estimate = estimate_pose(replace(scan, name=name), replace(load_target("built"), name=name))
        shown = estimate._repr_html_()
        assert "<script" not in shown
        assert "\x1b" not in shown + repr(estimate)


def test_scans_with_hostile_names(world: Path, tmp_path: Path) -> None:
    for k, name in enumerate(name for name in NAMES if "/" not in name):
        path = tmp_path / f"{name}.pcd"
        shutil.copy(world / "4m.pcd", path)
        said = run(["estimate", str(path), "--target", "target.yaml", "--sensor", "sensor.yaml", "--json",
                    str(tmp_path / f"{k}.json")], world)  # fmt: skip
        assert problem_of(said) == "", name
        assert json.loads((tmp_path / f"{k}.json").read_text())["scans"][0]["scan"] == str(path)


def test_progress_without_a_terminal_is_a_line_now_and_then(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("optshape_graph.cli.console.SECONDS_BETWEEN", 0.0)
    said = run(LINE, world)
    assert any(line.startswith("optshape: estimating: 1 of 2 after 0 min, ") for line in said.err.splitlines())


def test_started_processes_are_ended(world: Path) -> None:
    with started(LINE, world) as child:
        pass
    assert child.poll() is not None
