"""A program that reads a file with native code and writes its content as arrays: `python -m ... FORMAT FILE FILE.npz`.

It runs in a process of its own, because damaged files crash or hang the native readers (ezc3d for C3D, scipy.io for
MAT, Open3D for meshes, lazrs for LAZ, libE57 for E57): 6 of 60 damaged copies of a small C3D file did (ezc3d 1.7.2),
and some of thousands of a MAT file (scipy 1.17.1). The caller then gets an error, and goes on.
"""

from __future__ import annotations

import importlib
import os
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph.errors import InputError, missing_extra

SECONDS = 120
"""Seconds that reading a file may take."""

BYTES = 512 << 20
"""Bytes of memory that reading any file may take, beside the library; a test reads damaged files within it."""

TIMES = 20
"""Memory that reading a file may take, as a multiple of its size; five times as much for LAZ, which is compressed."""

ABSENT = 3
"""Exit status where the library cannot be imported."""

_LIBRARIES = {
    "c3d": ("ezc3d", "mocap"), "mat": ("scipy", "mocap"), "mesh": ("open3d", "mesh"), "las": ("laspy[lazrs]", "las"),
    "e57": ("pye57", "e57"),
}  # fmt: skip
"""The library that reads each form, and the extra that brings it."""

Arrays = dict[str, NDArray[Any]]


def read_isolated(form: str, path: Path) -> Arrays:
    """Return the content of a file as arrays, in the file's own units.

    Args:
        form: "c3d", or "mat" as Qualisys Track Manager exports it; "mesh", of any format that Open3D reads; "las",
            compressed or not; or "e57" of one scan.
        path: the file.

    Returns:
        For markers `positions` (F, M, 3) with NaN for gaps, `labels`, `rate` and `unit`; for a mesh `vertices` (V, 3)
        and `triangles` (T, 3); for a cloud its columns.

    Raises:
        InputError: not readable.
        MissingExtraError: the library is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        arrays = Path(folder) / "markers.npz"
        # -P: a module in the current folder must not stand in for one of Python's.
        command = [sys.executable, "-P", "-m", "optshape_graph.io._isolated", form, str(path.resolve()), str(arrays)]
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
        try:
            child = subprocess.run(
                command, capture_output=True, text=True, timeout=SECONDS, check=False, env=environment
            )
        except subprocess.TimeoutExpired as error:
            raise InputError(f"{path}: not a readable {form} file: reading it did not end in {SECONDS} s") from error
        if child.returncode == ABSENT:
            raise missing_extra(*_LIBRARIES[form], ImportError(child.stderr.strip()))
        if child.returncode:
            said = child.stderr.strip().splitlines()[-1:] if child.returncode > 0 else []
            reason = said[0] if said else f"its reader crashed (status {child.returncode})"
            raise InputError(f"{path}: not a readable {form} file: {reason}")
        with np.load(arrays, allow_pickle=False) as content:
            return dict(content)


def _read_c3d(path: str) -> Arrays:
    import ezc3d

    content = ezc3d.c3d(path)
    point = content["parameters"]["POINT"]
    points = np.asarray(content["data"]["points"], dtype=float)[:3].transpose(2, 1, 0)
    residuals = np.asarray(content["data"]["meta_points"]["residuals"], dtype=float)[0].T
    labels = [str(label) for key in _counted(point, "LABELS") for label in point[key]["value"]]
    computed = Counter(
        str(label) for group in _COMPUTED for key in _counted(point, group) for label in point[key]["value"]
    )
    markers = []
    for k in reversed(
        range(min(len(labels), points.shape[1]))
    ):  # a model's output may have a marker's name; it comes later
        if computed[labels[k]]:
            computed[labels[k]] -= 1
        else:
            markers.append(k)
    markers.reverse()
    kept = markers if len(labels) >= points.shape[1] else list(range(points.shape[1]))
    return {
        "positions": np.where(residuals[:, kept, None] < 0, np.nan, points[:, kept]),
        "labels": np.array([labels[k] for k in kept] if len(labels) >= points.shape[1] else labels, dtype=str),
        "outputs": np.array(sorted(set(labels) - {labels[k] for k in markers}), dtype=str),
        "first_frame": np.array(int(content["header"]["points"]["first_frame"])),
        "unit": np.array(str(point["UNITS"]["value"][0])),
        "rate": np.array(float(point["RATE"]["value"][0])),
    }


_COMPUTED = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "REACTIONS", "MODELED_MARKERS")
"""Parameters of C3D's POINT that list the labels of a model's outputs."""


def _counted(point: Any, name: str) -> list[str]:
    """Return a parameter and its continuations in order: LABELS, LABELS2, LABELS3, ..."""
    keys = [key for key in point if key == name or (key.startswith(name) and key[len(name) :].isdecimal())]
    return sorted(keys, key=lambda key: int(key[len(name) :] or 1))


def _read_mat(path: str) -> Arrays:
    from scipy.io import loadmat

    content = loadmat(path, simplify_cells=True)
    takes = [value for value in content.values() if isinstance(value, dict) and "Trajectories" in value]
    if not takes:
        raise ValueError("no structure with Trajectories in it")
    labeled = takes[0]["Trajectories"]["Labeled"]
    labels = [str(label) for label in np.atleast_1d(labeled["Labels"])]
    data = np.asarray(labeled["Data"], dtype=float)
    if data.ndim == 2:  # MATLAB drops the dimension of a single marker or frame
        data = data[None] if len(labels) == 1 else data[:, :, None]
    if data.ndim != 3 or data.shape[1] < 3:
        raise ValueError(f"data of shape {data.shape}, expected labels x 4 x frames")
    return {
        "positions": data[:, :3].transpose(2, 0, 1),
        "labels": np.array(labels),
        "unit": np.array("mm"),
        "rate": np.array(float(takes[0]["FrameRate"])),
    }


def _read_mesh(path: str) -> Arrays:
    try:
        import open3d
    except OSError as error:  # a system library that Open3D loads is absent
        raise ImportError(str(error)) from error
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh = open3d.io.read_triangle_mesh(Path(path))
    return {"vertices": np.asarray(mesh.vertices), "triangles": np.asarray(mesh.triangles)}


def _read_las(path: str) -> Arrays:
    import laspy

    _check_records(path)
    with laspy.open(path) as stream:
        cloud = stream.read()
    arrays = {axis: np.asarray(cloud[axis], dtype=float) for axis in "xyz"}
    for name in cloud.point_format.dimension_names:
        if name.lower() not in ("x", "y", "z"):
            values = np.asarray(cloud[name])
            if values.shape == arrays["x"].shape and values.any():  # a dimension that nobody filled is left out
                arrays[name] = values
    return arrays


_RECORDS = ((100, 54), (243, 60))
"""Where a LAS header counts its variable length records and the extended ones (of version 1.4), and their least bytes
(ASPRS, LAS 1.4 R15)."""


def _check_records(path: str) -> None:
    """Refuse a LAS header that counts more records than fit: its reader would make them all, out of nothing."""
    size = os.path.getsize(path)
    with open(path, "rb") as stream:
        header = stream.read(247)
    for place, least in _RECORDS[: 2 if header[25:26] >= b"\x04" else 1]:
        count = int.from_bytes(header[place : place + 4], "little")
        if count * least > size:
            raise ValueError(f"its header counts {count} records, more than its {size} bytes hold")


def _read_e57(path: str) -> Arrays:
    import pye57

    with pye57.E57(path) as stream:
        if stream.scan_count != 1:
            raise ValueError(f"{stream.scan_count} scans in it; expected one")
        found = stream.read_scan_raw(0)
    arrays = {key.removeprefix("cartesian").lower(): np.asarray(values) for key, values in found.items()}
    if not {"x", "y", "z"} <= arrays.keys() and "sphericalRange" in found:
        r, azimuth, elevation = (np.asarray(found[f"spherical{part}"]) for part in ("Range", "Azimuth", "Elevation"))
        arrays |= {
            "x": r * np.cos(elevation) * np.cos(azimuth), "y": r * np.cos(elevation) * np.sin(azimuth),
            "z": r * np.sin(elevation),
        }  # fmt: skip
    invalid = arrays.pop("invalidstate", None)
    if invalid is not None:
        for axis in "xyz":
            arrays[axis] = np.where(invalid != 0, np.nan, arrays[axis])
    return {{"rowindex": "row_index", "columnindex": "column_index"}.get(key, key): arrays[key] for key in arrays}


def _limit_memory(form: str, path: str) -> None:
    """Limit the memory of this process by `BYTES` and `TIMES`."""
    importlib.import_module(_LIBRARIES[form][0].partition("[")[0])
    pages = Path("/proc/self/statm")
    taken = int(pages.read_text().split()[5]) * resource.getpagesize() if pages.exists() else 1 << 30
    times = 5 * TIMES if path.lower().endswith(".laz") else TIMES
    most = taken + max(BYTES, times * os.path.getsize(path))
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))


def main(form: str, path: str, arrays: str) -> int:
    """Read `path`, write `arrays`; return the exit status."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    readers: dict[str, Callable[[str], Arrays]] = {
        "c3d": _read_c3d, "mat": _read_mat, "mesh": _read_mesh, "las": _read_las, "e57": _read_e57,
    }  # fmt: skip
    try:
        _limit_memory(form, path)
        content = readers[form](path)
    except MemoryError:
        print("it needs more memory than a file of its size should", file=sys.stderr)
        return 1
    except ImportError as error:
        print(error, file=sys.stderr)
        return ABSENT
    np.savez(arrays, **content)  # type: ignore[arg-type]  # the stubs take **kwds for allow_pickle
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
