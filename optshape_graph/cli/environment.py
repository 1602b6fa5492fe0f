"""The installation: Python, the packages of the core and of each extra, and the system's libraries."""

from __future__ import annotations

import ctypes
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any

DISTRIBUTION = "optshape-graph"

MODULES = {
    "cyclonedx-bom": "cyclonedx_py",
    "opencv-python-headless": "cv2",
    "pymdown-extensions": "pymdownx",
    "python-neo-lzf": "lzf",
    "pyyaml": "yaml",
    "rerun-sdk": "rerun",
}
"""Modules by their distribution, if its name is another."""

PURPOSES = {
    "sdp": "certificates by cvxpy, for comparison (--backend cvxpy)",
    "plot": "pictures (--plot)",
    "design": "drawings of targets (optshape design)",
    "camera": "LiDAR-camera calibration (optshape calibrate camera)",
    "ros": "ROS 1 and ROS 2 bags, without ROS",
    "mocap": "C3D files of motion capture",
    "las": "LAS and LAZ clouds",
    "e57": "E57 clouds",
    "velodyne": "packets of Velodyne sensors: pcap and VelodyneScan",
    "ouster": "packets of Ouster sensors (not beside `ros`: install it with pip --no-deps)",
    "mesh": "meshes in simulated scenes, and the Open3D viewer",
    "pcd": "compressed PCD clouds read fast (LibLZF)",
    "icp": "odometry from the scans themselves (KISS-ICP)",
    "evaluate": "accuracy sweeps and tables (optshape evaluate)",
    "dataframe": "results as pandas data frames (to_dataframe)",
    "dask": "sweeps on several machines (--dask)",
    "view": "the Rerun viewer (optshape view)",
    "notebooks": "the notebooks, in Jupyter",
    "supply": "the list of parts (make sbom)",
    "docs": "building the documentation",
}
"""Purpose of each extra; `test` brings them all."""

CORE = {
    "gtsam": "factor graphs",
    "numpy": "arrays",
    "scipy": "statistics, special functions",
    "clarabel": "the semidefinite program behind the certificate",
    "pyyaml": "target, sensor and session files",
    "click": "the command line",
    "rich": "tables and progress",
}

SYSTEM = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
}
"""Libraries that Open3D loads, and the packages of Debian and Ubuntu that hold them."""

_IMPORTS = """
import importlib, importlib.metadata, json, sys
for distribution, module in json.loads(sys.argv[1]):
    print(json.dumps({"trying": distribution}), flush=True)
    try:
        loaded = importlib.import_module(module)
        try:
            version = importlib.metadata.version(distribution)
        except importlib.metadata.PackageNotFoundError:
            version = str(getattr(loaded, "__version__", "unknown"))
        print(json.dumps({"distribution": distribution, "version": version}), flush=True)
    except BaseException as error:
        absent = isinstance(error, ModuleNotFoundError) and error.name == module
        said = "" if absent else f"{type(error).__name__}: {error}"
        print(json.dumps({"distribution": distribution, "error": said}), flush=True)
"""

SECONDS = 120
"""Seconds that importing everything may take."""


@dataclass(frozen=True)
class Found:
    """The outcome of importing a package.

    Attributes:
        version: of the package; None: it could not be imported.
        error: the reason; "": it is not installed.
    """

    version: str | None
    error: str = ""


def requirements() -> dict[str, dict[str, str]]:
    """Return the required versions of each distribution, by extra ("": the core).

    Without the package's metadata (a bare source tree on the path) only the names of the core are known.
    """
    try:
        lines = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return {"": dict.fromkeys(CORE, "")}
    required: dict[str, dict[str, str]] = {"": {}}
    for line in lines:
        requirement, _, marker = line.partition(";")
        name = re.match(r"[A-Za-z0-9._-]+", requirement.strip())
        extra = re.search(r"extra == ['\"]([^'\"]+)['\"]", marker)
        if name and name[0] != DISTRIBUTION:
            versions = re.sub(r"\[[^]]*\]", "", requirement.strip()[len(name[0]) :]).strip()
            required.setdefault(extra[1] if extra else "", {})[name[0].lower()] = versions
    return required


def import_all(distributions: Sequence[str]) -> dict[str, Found]:
    """Import packages in another process, so that a crash is a finding and does not end this one."""
    found: dict[str, Found] = {}
    remaining = [[name, MODULES.get(name, name.replace("-", "_"))] for name in distributions]
    while remaining:
        trying = remaining[0][0]
        why = ""
        for line, ended in _output_of(remaining):
            why = ended
            if "trying" in line:
                trying = line["trying"]
            elif "distribution" in line:
                found[line["distribution"]] = Found(line.get("version"), line.get("error", ""))
        if trying not in found:
            found[trying] = Found(None, why or "importing it ended the process")
        remaining = [item for item in remaining if item[0] not in found]
    return found


def satisfies(version: str, wanted: str) -> bool:
    """Return whether a version is within bounds such as `>=4.3,<4.4`."""
    for bound in filter(None, (part.strip() for part in wanted.split(","))):
        match = re.match(r"(>=|<=|==|!=|~=|<|>)\s*([0-9.]+)", bound)
        if match is None:
            continue
        have, limit = _numbers(version), _numbers(match[2])
        n = max(len(have), len(limit))
        a, b = (parts + (0,) * (n - len(parts)) for parts in (have, limit))
        held = {
            ">=": a >= b, "<=": a <= b, "==": a == b, "!=": a != b, "<": a < b, ">": a > b,
            "~=": a >= b and a[: len(limit) - 1] == b[: len(limit) - 1],
        }[match[1]]  # fmt: skip
        if not held:
            return False
    return True


def missing_libraries(libraries: Mapping[str, str] = SYSTEM) -> dict[str, str]:
    """Return the system libraries that cannot be loaded, and the packages that hold them."""

    def loads(name: str) -> bool:
        try:
            ctypes.CDLL(name)
        except OSError:
            return False
        return True

    return {name: package for name, package in libraries.items() if not loads(name)}


def _output_of(modules: Sequence[Sequence[str]]) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the lines of a process that imports modules, each with how the process ended."""
    command = [sys.executable, "-c", _IMPORTS, json.dumps(list(modules))]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
        output, ended = done.stdout, ""
        if done.returncode < 0:
            ended = f"importing it ended the process with signal {-done.returncode}"
    except subprocess.TimeoutExpired as error:
        output = error.stdout.decode() if isinstance(error.stdout, bytes) else error.stdout or ""
        ended = f"importing it took more than {SECONDS} s"
    for line in output.splitlines():
        if line.startswith("{"):  # packages may print, too
            yield json.loads(line), ended
    yield {}, ended


def _numbers(version: str) -> tuple[int, ...]:
    parts = re.match(r"[0-9]+(\.[0-9]+)*", version)
    return tuple(int(part) for part in parts[0].split(".")) if parts else (0,)
