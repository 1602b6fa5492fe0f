"""Every option of every command, given what it should not be: generated from the commands themselves."""

from __future__ import annotations

import math
import random
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from optshape_graph.cli.main import cli
from optshape_graph.cli.options import Number
from tests.faults.harness import MANY, changed, problem_of, run, snapshot
from tests.faults.inputs import HOSTILE, make_bad, make_inputs

for library in ("matplotlib", "pyarrow", "ezdxf"):
    pytest.importorskip(library)

RUNS = {
    "info": "info 4m.pcd --json out/a.json",
    "report": "report result.json -o out/a.html",
    "estimate": "estimate 4m.pcd --target target.yaml --sensor sensor.yaml --json out/a.json",
    "detect": "detect room.pcd --target square@1 --sensor vlp16 --json out/a.json",
    "calibrate mocap": "calibrate mocap session.yaml --json out/a.json",
    "calibrate camera": "calibrate camera session.yaml --json out/a.json",
    "calibrate rig": "calibrate rig session.yaml --json out/a.json",
    "calibrate sensor": "calibrate sensor clouds square@1 --sensor vlp16 -o out/a.yaml",
    "design choose": "design choose --sensor vlp32c --range 6 --rotation 8 --translation 0.1 -o out/a.yaml",
    "design measured": "design measured square --length 0-1=1001 --length 0-2=1415 -o out/a.yaml",
    "design optimise-poses": "design optimise-poses --sensor vlp32c --range 8 --placements 4 --starts 1 -o out/a.yaml",
    "design optimise": "design optimise --starts 1 --sides 3 --rings 1 2 --area 0.5 -o out/a.yaml",
    "design score": "design score triangle --sensor vlp16 -o out/a.json",
    "design export": "design export square --format svg -o out/a.svg",
    "design study": "design study --shapes 0 --distances 8 --placements 1 -o out/study",
    "simulate": "simulate --range 5 --sensor vlp16 -o out/a.pcd",
    "extract": "extract clouds --sensor vlp16 --target square@1 -o out/cut",
    "map": "map clouds --targets square@1 --sensor vlp16 --json out/a.json",
    "merge": "merge map.json other.json --json out/a.json",
    "evaluate simulation": "evaluate simulation --distance 4 --rpy 0 0 0 --noise 0 --seeds 1 --method global -o out/e",
    "evaluate mocap": "evaluate mocap . -o out/e",
    "evaluate paper": "evaluate paper --draws 1 -o out/e",
    "view": "view 4m.pcd --save out/a.rrd",
    "demo": "demo -o out/demo",
    "doctor": "doctor --json out/a.json",
    "completion": "completion bash",
}
"""A good run of every command, in the folder of the inputs."""

NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "1e309",
    "-1e300",
    "1e300",
    "-1",
    "0",
    "1e-300",
    "",
    "abc",
    "1,5",
    "0x10",
    "9" * 400,
    "١",
)
OUTPUTS = (
    "no/such/folder/a", "bad", "4m.pcd", "session.yaml", "precious.json", "precious.yaml", "precious.txt", "/proc/a",
    "precious.txt/a", "x" * 300, "/dev/full", "", ".", "out/../4m.pcd", "bad/loop.pcd",
)  # fmt: skip

FOLDERS = ("out/new/folder", "4m.pcd", "precious.txt", "precious.txt/a", "x" * 300, "/dev/full", "/proc/a", "")

SLOW = {
    "calibrate mocap": 6, "calibrate camera": 6, "calibrate sensor": 12, "calibrate rig": 6, "design study": 8,
    "map": 3, "demo": 8, "evaluate simulation": 4, "evaluate mocap": 8, "evaluate paper": 40, "design choose": 40,
    "design optimise": 4, "design optimise-poses": 4, "doctor": 10,
}  # fmt: skip
"""Commands whose good runs take seconds: every so manieth case of theirs is tried in `make test`."""


def leaf(name: str) -> click.Command:
    """A command by its name."""
    found: click.Command = cli
    for word in name.split():
        assert isinstance(found, click.Group)
        inner = found.get_command(click.Context(found), word)
        assert inner is not None
        found = inner
    return found


def values(parameter: click.Parameter, bad: list[str]) -> list[str]:
    """What a parameter is to be given."""
    name = parameter.name or ""
    kind = parameter.type
    if isinstance(kind, click.Choice):
        return ["", "nonsense", "GLOBAL", *HOSTILE[4:7]]
    if isinstance(kind, click.types.IntParamType | click.types.FloatParamType) or type(kind).__name__ == "Number":
        return list(NUMBERS)
    written = name in ("output", "html", "plots", "plot", "camchain", "recording", "export") or name.endswith(
        ("_file", "json_path")
    )
    if written and name not in ("camera_file", "mocap_file"):
        return list(FOLDERS if isinstance(kind, click.Path) and not kind.file_okay else OUTPUTS)
    if isinstance(kind, click.Path) or name in ("scans", "shapes", "shape"):
        return [*bad, *HOSTILE]
    return [*HOSTILE, *bad[:6], *NUMBERS[:4]]


def cases(bad: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Command lines, each with the name of its command."""
    for name, line in RUNS.items():
        words = line.split()
        for parameter in leaf(name).params:
            if getattr(parameter, "is_flag", False):
                yield name, [*words, parameter.opts[0]]
                continue
            for value in values(parameter, bad):
                given = [value] * max(parameter.nargs, 1)
                if isinstance(parameter, click.Option):
                    yield name, [*words, parameter.opts[0], *given]
                else:
                    at = len(name.split())
                    yield name, [*words[:at], *given, *words[at + 1 :]]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the runs are in."""
    folder = tmp_path_factory.mktemp("faults") / "outer" / "world"
    folder.parent.mkdir()
    make_inputs(folder)
    make_bad(folder / "bad")
    for ending in ("json", "yaml", "txt"):
        (folder / f"precious.{ending}").write_text("years of work\n")
    return folder


def chosen(name: str, bad: list[str]) -> list[list[str]]:
    """The cases of a command that are tried: by `make test` a share, the same every time, by `make faults` more."""
    mine = [arguments for command, arguments in cases(bad) if command == name]
    count = -(-MANY * len(mine) // (4 * SLOW.get(name, 1)))
    return random.Random(zlib.crc32(name.encode())).sample(mine, min(count, len(mine)))


@pytest.mark.parametrize("name", RUNS)
def test_options(name: str, world: Path) -> None:
    bad = sorted(f"bad/{path.name}" for path in (world / "bad").iterdir())
    bad += ["/dev/null", "/dev/zero", "nope.pcd", "x" * 300, "bad", ".", "/", "@bad/list.txt", "@nope", "bad/*.none",
            "/proc/self/mem"]  # fmt: skip
    outer = world.parents[1]
    before = snapshot(outer)
    wrong: list[str] = []
    for arguments in chosen(name, bad):
        (world / "out").mkdir(exist_ok=True)
        said = run(arguments, world)
        after = snapshot(outer)
        lost = changed(before, after, ("outer/world/out", "outer/world/no"))
        if problem := problem_of(said) or (f"changed {lost}" if lost else ""):
            wrong.append(f"{arguments}: {problem}")
            shutil.rmtree(world)
            make_inputs(world)
            make_bad(world / "bad")
            for ending in ("json", "yaml", "txt"):
                (world / f"precious.{ending}").write_text("years of work\n")
            before = snapshot(outer)
        shutil.rmtree(world / "out", ignore_errors=True)
    assert not wrong, "\n".join([f"{len(wrong)} went wrong", *wrong])


def leaves(group: click.Group, words: str = "") -> Iterator[str]:
    """Names of all commands."""
    for word in group.list_commands(click.Context(group)):
        found = group.get_command(click.Context(group), word)
        name = f"{words} {word}".strip()
        if isinstance(found, click.Group):
            yield from leaves(found, name)
        else:
            yield name


def test_every_number_has_a_range() -> None:
    for name in RUNS:
        for parameter in leaf(name).params:
            kind = parameter.type
            if isinstance(kind, Number):
                assert kind.finite or kind.least > -math.inf, (name, parameter.name)
            elif isinstance(kind, click.types.IntParamType | click.types.FloatParamType):
                assert isinstance(kind, click.IntRange), (name, parameter.name)
                assert None not in (kind.min, kind.max), (name, parameter.name)


def test_every_command_is_tried() -> None:
    assert set(leaves(cli)) == set(RUNS)


def test_there_are_enough() -> None:
    assert len(list(cases(["bad"] * 40))) >= 400
