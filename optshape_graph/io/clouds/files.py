"""Cloud files: the first bytes of a file, or else its ending, tell which reader it needs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from optshape_graph.errors import InputError, expect
from optshape_graph.io._isolated import read_isolated
from optshape_graph.io.clouds.binary import read_binary
from optshape_graph.io.clouds.columns import Columns
from optshape_graph.io.clouds.npz import read_npy, read_npz
from optshape_graph.io.clouds.pcd import read_pcd, write_pcd
from optshape_graph.io.clouds.ply import read_ply
from optshape_graph.io.clouds.scans import use_up
from optshape_graph.io.clouds.text import read_csv
from optshape_graph.io.files import read_bytes, read_head
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel

ENDINGS = {
    ".pcd": "pcd", ".ply": "ply", ".npz": "npz", ".npy": "npy", ".csv": "text", ".txt": "text", ".xyz": "text",
    ".asc": "text", ".bin": "binary", ".las": "las", ".laz": "las", ".e57": "e57",
}  # fmt: skip
"""Forms by ending."""

BEGINNINGS = {
    b"ply": "ply", b"\x93NUMPY": "npy", b"PK\x03\x04": "npz", b"LASF": "las", b"ASTM-E57": "e57",
    b"# .PCD": "pcd", b"#.PCD": "pcd", b"VERSION": "pcd", b"VERSION .7": "pcd",
    b"\xd4\xc3\xb2\xa1": "packets", b"\xa1\xb2\xc3\xd4": "packets", b"\x4d\x3c\xb2\xa1": "packets",
    b"\xa1\xb2\x3c\x4d": "packets", b"\n\r\r\n": "packets", b"#ROSBAG": "bag", b"\x89MCAP0": "bag",
    b"SQLite format 3": "bag",
}  # fmt: skip
"""Forms by the first bytes; these win over the ending."""


def form_of_head(head: bytes) -> str | None:
    """Return the form of a file by its first bytes: of a cloud, "packets" or "bag"; None: they do not tell."""
    return next((form for beginning, form in BEGINNINGS.items() if head.startswith(beginning)), None)


def form_of(path: str | Path) -> str:
    """Return the form of a cloud's file: "pcd", "ply", "npz", "npy", "text", "binary", "las" or "e57".

    Raises:
        InputError: no such file, another kind of file, or an ending that is not known.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(
            f"{path}: a folder; expected one cloud (a folder of clouds is read by `optshape map` and `extract`)"
        )
    form = form_of_head(read_head(path, 64))
    if form in ("packets", "bag"):
        what = "captured packets (pcap)" if form == "packets" else "a bag"
        raise InputError(f"{path}: {what}, of many scans; expected one cloud: take them out with `optshape extract`")
    form = form or ENDINGS.get(path.suffix.lower())
    if form is None:
        raise InputError(f"{path}: expected a cloud ending in {', '.join(ENDINGS)}, found '{path.suffix.lower()}'")
    return form


def read_columns(path: str | Path, names: Sequence[str] | None = None) -> Columns:
    """Return the columns of a cloud's file, as recorded; see `read_scan` for the forms.

    Raises:
        InputError: as `read_scan`.
        MissingExtraError: the library for LAS or E57 is absent.
    """
    form = form_of(path)
    if names is not None and form not in ("text", "binary", "npy"):
        raise InputError(f"{path}: names of columns are given, but a file of this form ({form}) has its own")
    if form == "text":
        return read_csv(path, names)
    if form == "binary":
        return read_binary(path, None if names is None else tuple(names))
    if form == "npy":
        return read_npy(path, names)
    if form in ("las", "e57"):
        read_bytes(path)  # missing, unreadable, too large
        return Columns(dict(read_isolated(form, Path(path))), name=str(path))
    return {"pcd": read_pcd, "ply": read_ply, "npz": read_npz}[form](path)


def read_scan(
    path: str | Path,
    sensor: SensorModel | None = None,
    columns: Sequence[str] | None = None,
    unused: Counter[str] | None = None,
) -> Scan:
    """Read a scan from a cloud's file; see `make_scan` for how columns become a scan.

    The forms are PCD (ascii, binary, binary_compressed), PLY, NPZ and NPY, text (CSV with any separator, VeloView,
    Ouster Studio, CloudCompare), KITTI's `.bin`, nuScenes' `.pcd.bin`, LAS and LAZ, E57.

    Args:
        path: the file.
        sensor: the sensor that made it, if known.
        columns: names of the columns, in order, for a file without names (text, floats, a NumPy array); "_" skips one.
        unused: counter, by name, of columns that do not go into the scan.

    Raises:
        InputError: an unknown form, a file that is damaged or of another form than it seems, columns that do not make
            a scan, or a sensor that is no SensorModel.
        MissingExtraError: the library for LAS or E57 is absent.
    """
    expect("path", path, str, Path)
    return use_up(read_columns(path, columns), sensor, unused=unused)


def read_scans(
    paths: Sequence[str | Path], sensor: SensorModel | None = None, columns: Sequence[str] | None = None
) -> tuple[dict[int, Scan], dict[int, InputError]]:
    """Read scans from clouds' files: those that can be read, and why the others can't, by their number from 0.

    Args:
        paths: of the files.
        sensor: as for `read_scan`.
        columns: as for `read_scan`.
    """
    scans: dict[int, Scan] = {}
    errors: dict[int, InputError] = {}
    for k, path in enumerate(paths):
        try:
            scans[k] = read_scan(path, sensor, columns)
        except InputError as error:
            errors[k] = error
    return scans, errors


def write_scan(path: str | Path, scan: Scan) -> None:
    """Write a scan as a binary PCD file that `read_scan`, PCL and Open3D read.

    Coordinates, intensity and time become 32-bit floats, as drivers publish them (at 100 m, rounding is 4 um); rings
    become 16-bit integers.

    Raises:
        InputError: a path that does not end in .pcd, or a file that cannot be written.
    """
    if Path(path).suffix.lower() != ".pcd":
        raise InputError(f"{path}: expected a name ending in .pcd")
    columns: dict[str, NDArray[Any]] = {axis: scan.points[:, i].astype("<f4") for i, axis in enumerate("xyz")}
    if scan.intensity is not None:
        columns["intensity"] = scan.intensity.astype("<f4")
    if scan.ring is not None:
        columns["ring"] = scan.ring.astype("<u2")
    if scan.time is not None:
        columns["time"] = scan.time.astype("<f4")
    write_pcd(path, columns)
