"""Results are there whole or not at all: whatever the disk, the permissions or the user's patience do."""

from __future__ import annotations

import ast
import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import optshape_graph
from optshape_graph.errors import InputError
from optshape_graph.io.files import write_atomically
from tests.cli.test_outputs import RUNS, inputs
from tests.io.test_bad_inputs import said

PACKAGE = Path(optshape_graph.__file__).parent

__all__ = ["inputs"]  # a fixture

WRITERS = {
    "write_text", "write_bytes", "imwrite", "savefig", "saveas", "savez", "savez_compressed", "savetxt", "tofile",
    "to_csv", "to_parquet", "write_table", "write_image", "write_point_cloud", "write_triangle_mesh", "copyfile",
    "copytree",
}  # fmt: skip
"""Functions of libraries that write files; those that write to an open one need an `open`."""

IN_MEMORY = {"buffer", "stream", "sink", "pages"}
"""Names that the package gives to what it writes in memory first."""

ALLOWED = {
    "io/files.py",  # the one that writes
    "io/_isolated.py",  # arrays for its parent, in a temporary folder
    "compiled/build.py",  # the library, where a wheel is built or a checkout is set up; it runs without the package
}


def writes(path: Path) -> Iterator[str]:
    """Calls in a module that write a file themselves."""
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call):
            continue
        names = {part.id for part in [*node.args, getattr(node.func, "value", None)] if isinstance(part, ast.Name)}
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        written = name in WRITERS or (name == "save" and "np" in names)
        if name == "open":
            given = node.args[0 if isinstance(node.func, ast.Attribute) else 1 :][:1]
            given += [keyword.value for keyword in node.keywords if keyword.arg == "mode"]
            modes = [str(mode.value) for mode in given if isinstance(mode, ast.Constant)]
            written = any(set(mode) & set("wax+") and set(mode) <= set("rwaxbt+") for mode in modes)
        if written and not names & IN_MEMORY:
            yield f"{path.name}:{node.lineno}: {ast.unparse(node.func)}"


def test_everything_is_written_by_one_module() -> None:
    found = [
        call
        for path in sorted(PACKAGE.rglob("*.py"))
        if str(path.relative_to(PACKAGE)) not in ALLOWED
        for call in writes(path)
    ]
    assert found == []


def test_the_check_sees_what_it_looks_for(tmp_path: Path) -> None:
    lines = ["open('a', 'w')", "p.open('xb')", "p.write_text('a')", "np.savez('a', b)", "figure.savefig(path)",
             "cv2.imwrite('a', b)", "open('a', mode='a')"]  # fmt: skip
    fine = ["open('a')", "p.open('rb')", "figure.savefig(buffer)", "a.copy()", "pictures.save('a', b)"]
    for line in lines:
        (tmp_path / "a.py").write_text(line)
        assert list(writes(tmp_path / "a.py")), line
    for line in fine:
        (tmp_path / "a.py").write_text(line)
        assert not list(writes(tmp_path / "a.py")), line


@pytest.mark.parametrize("name", sorted(RUNS.keys() - {"doctor"}))
def test_a_full_disk_leaves_nothing_and_says_so(
    name: str,
    inputs: dict[str, Path],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    line = RUNS[name][0].format(out=tmp_path, **inputs)
    status, error = said(line, capfd, monkeypatch)
    assert status == 2
    last = error.splitlines()[-1]
    assert last.startswith("optshape: error: ")
    assert last.endswith("cannot be written (No space left on device)")
    left = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert [path for path in left if path.suffix != ".journal"] == []  # what is finished is kept for the next time


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 kB."""
    place = tmp_path / "small"
    place.mkdir()
    mounted = os.geteuid() == 0 and not subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)], capture_output=True, check=False
    ).returncode  # fmt: skip
    if not mounted:
        pytest.skip("no file system can be mounted here")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=False)


def test_a_disk_that_is_full_or_read_only(
    small_disk: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_atomically(small_disk / "a.pcd", "old")
    status, error = said(f"simulate --range 3 -o {small_disk}/a.pcd --force", capsys, monkeypatch)
    assert status == 2
    assert f"bytes are free at {small_disk}; about" in error  # it is found out before the work
    for _ in range(2):
        with pytest.raises(InputError, match=r"a\.pcd: cannot be written \(No space left on device\)"):
            write_atomically(small_disk / "a.pcd", b"new" * (1 << 20))
        assert [path.name for path in small_disk.iterdir()] == ["a.pcd"]
        assert (small_disk / "a.pcd").read_text() == "old"
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    status, error = said(f"design score square -o {small_disk}/b.json", capsys, monkeypatch)
    assert (status, error) == (
        2, f"optshape: error: --output: nothing can be written to {small_disk} (Read-only file system)\n",
    )  # fmt: skip


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
from optshape_graph.cli.main import main
main()
"""


def test_a_limit_on_the_size_of_files(tmp_path: Path) -> None:
    unmeasured = {key: value for key, value in os.environ.items() if not key.startswith("COV")}  # which writes, too
    child = subprocess.run(
        [sys.executable, "-c", LIMITED, "simulate", "--range", "6", "-o", str(tmp_path / "a.pcd")],
        capture_output=True, text=True, check=False, env=unmeasured,
    )  # fmt: skip
    assert child.returncode == 2
    assert child.stderr == f"optshape: error: {tmp_path}/a.pcd: cannot be written (File too large)\n"
    assert list(tmp_path.iterdir()) == []


SLOW = """
import os, sys, time
from optshape_graph.errors import InputError
from optshape_graph.io.files import write_atomically
def wait(_):
    print("written", flush=True)
    time.sleep(60)
os.fsync = wait
write_atomically(sys.argv[1], "new" * 100000)
"""


@pytest.mark.parametrize("before", [None, "old"])
def test_killed_half_way(tmp_path: Path, before: str | None) -> None:
    path = tmp_path / "result.json"
    if before is not None:
        write_atomically(path, before)
    child = subprocess.Popen([sys.executable, "-c", SLOW, str(path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    assert child.stdout.readline() == "written\n"
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    assert (path.read_text() if path.exists() else None) == before
    (left,) = [file for file in tmp_path.iterdir() if file != path]
    assert left.name.startswith(".result.json.")  # what it is of, hidden, and by its ending nobody's input
    assert left.name.endswith(".tmp")
    write_atomically(path, "newer")
    assert path.read_text() == "newer"


def test_a_killed_command_leaves_whole_files_only(tmp_path: Path) -> None:
    """Killed again and again at any moment, a sweep has whole tasks only, and ends where it would have ended."""
    import json

    line = ["evaluate", "simulation", "--distance", "3", "--distance", "4", "--rpy", "0", "0", "0", "--noise", "1",
            "--seeds", "8", "--method", "global", "-o"]  # fmt: skip
    command = [sys.executable, "-m", "optshape_graph", *line, str(tmp_path / "out")]
    for wait in (1.5, 2.5):
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(wait)
        child.kill()
        child.wait()
        for path in (tmp_path / "out").rglob("*.json"):
            json.loads(path.read_text())
    assert subprocess.run(command, capture_output=True, check=False).returncode == 0
    assert (tmp_path / "out" / "scans.csv").exists()
