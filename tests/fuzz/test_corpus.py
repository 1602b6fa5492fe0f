"""What the fuzzer found once stays mended, and what it starts from is read: the corpus, replayed."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from optshape_graph.errors import OptshapeError
from tests.fuzz.__main__ import weigh
from tests.fuzz.readers import READERS

CORPUS = Path(__file__).parent / "corpus"

NEEDS = {
    "bag": ["rosbags"],
    "message": ["rosbags", "cv2"],
    "image": ["cv2"],
    "mocap-binary": ["ezc3d"],
    "survey": ["laspy", "lazrs", "pye57"],
    "capture": ["velodyne_decoder"],
    "any": ["cv2"],
    "yaml": ["cv2"],
}

LONGEST_S = 5.0
"""No input of the corpus, a few kilobytes each, takes longer."""


@pytest.mark.parametrize("name", READERS)
def test_the_corpus_is_read_or_refused(name: str, tmp_path: Path) -> None:
    for library in NEEDS.get(name, []):
        pytest.importorskip(library)
    reader = READERS[name]
    work = tmp_path / "work"
    work.mkdir()
    reader.furnish(work)
    before = os.listdir("/proc/self/fd")
    inputs = [*reader.seeds(tmp_path), *(file.read_bytes() for file in sorted((CORPUS / name).glob("*")))]
    for data in inputs:
        start = time.perf_counter()
        reader.read(data, work)
        assert time.perf_counter() - start < LONGEST_S
    assert len(os.listdir("/proc/self/fd")) <= len(before) + 2  # nothing stays open


@pytest.mark.parametrize("name", sorted(READERS.keys() - {"mocap-binary"}))
def test_some_seed_of_every_form_is_read(name: str, tmp_path: Path) -> None:
    """Else fuzzing would start at a closed door."""
    for library in NEEDS.get(name, []):
        pytest.importorskip(library)
    reader = READERS[name]
    work = tmp_path / "work"
    work.mkdir()
    reader.furnish(work)
    for number, form in enumerate(reader.forms):
        path = work / form.name
        path.parent.mkdir(exist_ok=True)
        (tmp_path / str(number)).mkdir()
        problems = []
        for seed in form.seeds(tmp_path / str(number)):
            path.write_bytes(seed)
            try:
                form.read(path)
            except OptshapeError as error:
                problems.append(str(error))
                continue
            break
        else:
            assert form.name.startswith(("sweep/", "folder/")), problems  # which need other files beside them


@pytest.mark.parametrize("name", sorted(READERS))
def test_reading_takes_little_memory(name: str, tmp_path: Path) -> None:
    for library in NEEDS.get(name, []):
        pytest.importorskip(library)
    inputs = tmp_path / "inputs"
    inputs.mkdir()
    for number, seed in enumerate(READERS[name].seeds(tmp_path)):
        (inputs / str(number)).write_bytes(seed)
    assert weigh(name, inputs) == 0


def test_the_fuzzer_runs(tmp_path: Path) -> None:
    pytest.importorskip("atheris")
    command = [sys.executable, "-m", "tests.fuzz", "lzf", "--seconds", "1", "--findings", str(tmp_path / "findings"),
               "--keep", str(tmp_path / "inputs")]  # fmt: skip
    child = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2])
    assert child.returncode == 0, child.stdout + child.stderr
    assert "lzf: 0 findings, exit status 0" in child.stdout
    assert "stat::number_of_executed_units" in child.stdout
    assert list((tmp_path / "inputs").iterdir())
