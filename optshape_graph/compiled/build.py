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


def sources() -> list[Path]:
    """Return the C files and what they include."""
    return sorted([*FOLDER.glob("*.c"), *FOLDER.glob("*.h")])


def mark() -> int:
    """Return a number that tells these sources from others: the library has that of those it was made of."""
    return zlib.crc32(b"".join(path.read_bytes() for path in sources()))


def compile_library() -> str:
    """Compile the library in its folder, where there is a compiler and it isn't there; say what was done.

    Never raises: a package without the library works.
    """
    import shlex
    import shutil
    import subprocess

    if LIBRARY.exists() and LIBRARY.stat().st_mtime > max(path.stat().st_mtime for path in sources()):
        return f"{LIBRARY} is there"
    compiler = shlex.split(os.environ.get("CC", "")) or [shutil.which("cc") or shutil.which("gcc") or ""]
    if os.environ.get("OPTSHAPE_COMPILED") == "off" or not shutil.which(compiler[0]):
        return "no compiler: NumPy alone"
    new = LIBRARY.with_suffix(f".{os.getpid()}.new")
    units = [str(path) for path in sources() if path.suffix == ".c"]
    command = [*compiler, *_FLAGS, f"-DSOURCES={mark()}u", "-o", str(new), *units, "-lm"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode == 0:
            os.replace(new, LIBRARY)
            return f"compiled {LIBRARY}"
        return f"NumPy alone: {' '.join(command)} failed: {result.stderr.strip()[-500:]}"
    except OSError as error:
        return f"NumPy alone: {error}"
    finally:
        new.unlink(missing_ok=True)


if __name__ == "__main__":
    print(compile_library())
