"""Compile the library where there is a compiler: run this file, or build a wheel.

It needs a C compiler (CC, or cc) and nothing else. Where there is none, nothing is made, and the NumPy code runs alone.
"""

from __future__ import annotations

import os
import zlib
from pathlib import Path

FOLDER = Path(__file__).parent

LIBRARY = FOLDER / "library.so"

_FLAGS = ("-O3", "-std=c11", "-fno-math-errno", "-fno-trapping-math", "-fopenmp-simd", "-shared", "-fPIC")


SEAL = 4
"""Bytes of the library's seal."""


def sources() -> list[Path]:
    """Return the C files and what they include."""
    return sorted([*FOLDER.glob("*.c"), *FOLDER.glob("*.h")])


def is_whole(library: bytes) -> bool:
    """Return whether a library was made of these sources, and nothing of it was lost or changed since.

    Loading one that was cut short would kill the process.
    """
    return library[-SEAL:] == _seal(library[:-SEAL])


def _seal(content: bytes) -> bytes:
    """What the library ends with, behind what the loader reads: a checksum of its content and its sources."""
    of_sources = zlib.crc32(b"".join(path.read_bytes() for path in sources()))
    return zlib.crc32(content, of_sources).to_bytes(SEAL, "little")


def compile_library() -> str:
    """Compile the library in its folder, where there is a compiler and it isn't there; say what was done.

    Never raises: a package without the library works.
    """
    import shlex
    import shutil
    import subprocess

    if LIBRARY.exists() and LIBRARY.stat().st_mtime > max(path.stat().st_mtime for path in sources()):
        return f"{LIBRARY} is there"
    try:
        compiler = shlex.split(os.environ.get("CC", "")) or [shutil.which("cc") or shutil.which("gcc") or ""]
    except ValueError as error:
        return f"NumPy alone: CC is {os.environ['CC']}: {error}"
    if os.environ.get("OPTSHAPE_COMPILED") == "off" or not shutil.which(compiler[0]):
        return "no compiler: NumPy alone"
    new = LIBRARY.with_suffix(f".{os.getpid()}.new")
    units = [str(path) for path in sources() if path.suffix == ".c"]
    command = [*compiler, *_FLAGS, "-o", str(new), *units, "-lm"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode == 0:
            with new.open("r+b") as file:
                file.write(_seal(file.read()))
            os.replace(new, LIBRARY)
            return f"compiled {LIBRARY}"
        return f"NumPy alone: {' '.join(command)} failed: {result.stderr.strip()[-500:]}"
    except OSError as error:
        return f"NumPy alone: {error}"
    finally:
        new.unlink(missing_ok=True)


if __name__ == "__main__":
    print(compile_library())
