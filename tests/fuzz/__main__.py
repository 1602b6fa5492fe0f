"""Coverage-guided fuzzing of one reader: `python -m tests.fuzz READER --seconds 300`.

Starts from what the package's own writers write and from the corpus, and keeps going past what it finds: every finding
of its own kind (exception and place) is a file, named after its hash, in `--findings`. Copy it to `corpus/READER` once
it is mended, and the ordinary tests replay it. A crash, a hang of more than 20 s or 3 GiB end the run with the input.
Then what reached something new is read once more, and the memory that it takes is held against its size.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import logging
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

CORPUS = Path(__file__).parent / "corpus"

TIMES = 20
"""Memory that reading may take, in sizes of the file, ..."""

BYTES = 8 << 20
"""... and beyond it, whatever the size: tables of a parser, buffers of a library."""


def fuzz(name: str, inputs: Path, findings: Path, seconds: int) -> None:
    """Fuzz in this process until the time is over; does not return."""
    import atheris

    with atheris.instrument_imports(include=["optshape_graph", "rosbags"], enable_loader_override=False):
        from tests.fuzz.readers import READERS
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    reader = READERS[name]
    reader.furnish(folder)
    seen: set[str] = set()

    def one(data: bytes) -> None:
        try:
            reader.read(data, folder)
        except Exception as error:
            frames = [f for f in traceback.extract_tb(error.__traceback__) if "optshape_graph" in f.filename]
            kind = f"{type(error).__name__} at {Path(frames[-1].filename).name}:{frames[-1].lineno}"
            if kind not in seen:
                seen.add(kind)
                file = findings / hashlib.sha256(data).hexdigest()[:16]
                file.write_bytes(data)
                print(f"FINDING {file}: {kind}: {error}", file=sys.stderr, flush=True)

    limits = [f"-max_total_time={seconds}", "-timeout=20", "-rss_limit_mb=3072", "-max_len=65536"]
    output = ["-print_final_stats=1", f"-artifact_prefix={findings}/"]
    atheris.Setup([sys.argv[0], *limits, *output, str(inputs), str(CORPUS / name)], one)
    atheris.Fuzz()


def weigh(name: str, inputs: Path) -> int:
    """Print how much memory reading takes at most, in sizes of the file; return 1 if that is too much."""
    from tests.fuzz.readers import READERS

    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    reader = READERS[name]
    reader.furnish(folder)
    contents = [file.read_bytes() for file in sorted([*inputs.glob("*"), *(CORPUS / name).glob("*")])]
    worst, size = 0.0, 0
    with _quiet():
        for data in contents[:50]:  # what is imported is imported
            reader.read(data, folder)
        for data in contents:
            taken = max(_memory(lambda data=data: reader.read(data, folder)) - BYTES, 0) / max(len(data), 1)
            worst, size = max((worst, size), (taken, len(data)))
    said = f", for one of {size} bytes" if worst else ""
    print(f"{name}: {len(contents)} inputs take {worst:.1f} times the file and {BYTES >> 20} MiB at most{said}")
    return int(worst > TIMES)


def _memory(read: Callable[[], object]) -> int:
    """Return the most memory, in bytes, that a call takes, whether it returns or raises."""
    import tracemalloc

    tracemalloc.start()
    try:
        with contextlib.suppress(Exception):  # a finding already
            read()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence warnings and the log meanwhile: those who weigh in a test have others after it."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logging.disable(before)


def main() -> int:
    """Run the fuzzer in a process of its own, and say how it went."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("reader")
    parser.add_argument("--seconds", type=int, default=300)
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"))
    parser.add_argument("--keep", type=Path, help="Keep inputs that reached something new in this folder.")
    parser.add_argument("--weigh", type=Path, metavar="FOLDER", help="Only weigh the inputs of this folder.")
    parser.add_argument("--inputs", type=Path, help=argparse.SUPPRESS)  # of the process that fuzzes
    options = parser.parse_args()
    if options.weigh:
        return weigh(options.reader, options.weigh)
    if options.inputs:
        fuzz(options.reader, options.inputs, options.findings, options.seconds)
        return 0
    from tests.fuzz.readers import READERS

    if options.reader not in READERS:
        parser.error(f"no reader '{options.reader}'; there are {', '.join(READERS)}")
    options.findings.mkdir(parents=True, exist_ok=True)
    (CORPUS / options.reader).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        inputs = options.keep or Path(folder) / "inputs"
        inputs.mkdir(parents=True, exist_ok=True)
        for number, seed in enumerate(READERS[options.reader].seeds(Path(folder))):
            (inputs / f"seed-{number}").write_bytes(seed)
        command = [sys.executable, "-m", "tests.fuzz", options.reader, f"--seconds={options.seconds}",
                   f"--findings={options.findings}", f"--inputs={inputs}"]  # fmt: skip
        child = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        heavy = weigh(options.reader, inputs)
    said = child.stderr.splitlines()
    found = [line for line in said if line.startswith("FINDING")]
    statistics = [line for line in said if line.startswith("stat::number_of_executed_units")]
    print(*(statistics or said[-30:]), *found, sep="\n")
    print(f"{options.reader}: {len(found)} findings, exit status {child.returncode}")
    return 1 if found or child.returncode or heavy else 0


if __name__ == "__main__":
    sys.exit(main())
