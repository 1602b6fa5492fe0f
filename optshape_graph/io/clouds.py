"""Clouds in, clouds out: files of every format become one `Scan`."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Floats, Ints
from optshape_graph.errors import InputError
from optshape_graph.io.columns import Columns
from optshape_graph.io.csv import read_csv
from optshape_graph.io.npz import read_npz
from optshape_graph.io.pcd import read_pcd, write_pcd
from optshape_graph.io.ply import read_ply
from optshape_graph.io.rings import rings_of_elevations, rings_of_ids
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel

_LOG = logging.getLogger(__name__)

POINT_NAMES = ("xyz", "points", "pts")
RING_NAMES = ("ring", "channel", "line", "laser_id", "row")
INTENSITY_NAMES = ("intensity", "reflectivity", "remission")
TIME_NAMES = ("t", "time", "timestamp", "time_offset", "offset_time")
"""Names of columns, whatever their case; where several occur the first counts."""

FARTHEST_M = 500.0
"""No LiDAR's median return is farther: beyond, the cloud is taken for one in millimetres."""

NO_RETURN_M = 1e6
"""Coordinates from here on, which some drivers write as the largest number there is, mean that nothing came back."""

LONGEST_SCAN_S = 10.0
"""A scan lasts less; what would last longer is in a smaller unit of time."""

_EPOCH_UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e9, 1.0))
"""Smallest time since 1970 in a unit, and the unit in seconds."""


def read_scan(path: str | Path, sensor: SensorModel | None = None) -> Scan:
    """Read a cloud: PCD (ascii, binary, binary_compressed), PLY, NPZ or CSV, by the file's ending.

    See `make_scan` for what becomes of the columns.

    Raises:
        InputError: an unknown ending, a file that is not what its ending says, or columns that make no scan.
    """
    readers: dict[str, Callable[[], Columns]] = {
        ".pcd": lambda: read_pcd(path),
        ".ply": lambda: read_ply(path),
        ".npz": lambda: read_npz(path),
        ".csv": lambda: read_csv(path, {"x", "y", "z", *RING_NAMES, *INTENSITY_NAMES, *TIME_NAMES}),
    }
    suffix = Path(path).suffix.lower()
    if suffix not in readers:
        raise InputError(f"{path}: expected a cloud ending in {', '.join(readers)}, found '{suffix}'")
    return make_scan(readers[suffix](), sensor)


def write_scan(path: str | Path, scan: Scan) -> None:
    """Write a scan as a binary PCD file that `read_scan`, PCL and Open3D read.

    Coordinates, intensity and time become 32-bit floats, as drivers publish them (at 100 m, rounding is 4 um); rings
    become 16-bit integers.

    Raises:
        InputError: a path that does not end in .pcd, rings that are not counted from 0, or a file that cannot be
            written.
    """
    if Path(path).suffix.lower() != ".pcd":
        raise InputError(f"{path}: expected a name ending in .pcd")
    columns: dict[str, NDArray[Any]] = {axis: scan.points[:, i].astype("<f4") for i, axis in enumerate("xyz")}
    if scan.intensity is not None:
        columns["intensity"] = scan.intensity.astype("<f4")
    if scan.ring is not None:
        columns["ring"] = _integers(scan.ring, str(path)).astype("<u2")
    if scan.time is not None:
        columns["time"] = scan.time.astype("<f4")
    write_pcd(path, columns)


@np.errstate(invalid="ignore", over="ignore")  # of signalling NaNs and absurd numbers that a file may hold
def make_scan(columns: Columns, sensor: SensorModel | None = None, stamp: float | None = None) -> Scan:
    """Make a scan of a cloud's columns.

    - Points are `xyz`, `points` or `pts` (N x 3), or `x`, `y`, `z`, in metres.
    - Points that are not finite, exactly at the origin, or beyond `NO_RETURN_M` are no returns: they go, with all their
      fields.
    - Rings are under one of `RING_NAMES`, of any integer type or floats that hold integers; or the rows (or columns) of
      an organised cloud with as many as the sensor has rings; or recovered from the elevations when the sensor is
      known; else there are none. However a driver numbers them, they come out counted from the lowest elevation, and
      as rows of the sensor's table where the sensor is known (see `rings`).
    - Time is under one of `TIME_NAMES`; the unit follows from type and size (see `_seconds`).

    Args:
        columns: a file's or a message's columns.
        sensor: the sensor that made the cloud, if known.
        stamp: the scan's own time, seconds since the epoch, from which absolute times of points are counted; None:
            from the earliest.

    Raises:
        InputError: no points or none left, columns of different lengths, millimetres, rings that are not integers, or
            a sensor whose table does not fit the elevations.
    """
    name = columns.name
    by_name = {key.lower(): values for key, values in columns.values.items()}
    recorded = _points(by_name, columns)
    there = (np.abs(recorded) < NO_RETURN_M).all(axis=1) & (recorded != 0).any(axis=1)  # False for NaN
    if not there.any():
        raise InputError(f"{name}: no returns ({len(recorded)} points, all at the origin, not finite, or out of reach)")

    def column(names: tuple[str, ...]) -> NDArray[Any] | None:
        key = next((key for key in names if key in by_name), None)
        if key is None:
            return None
        values = by_name[key]
        if values.size != len(recorded) or values.dtype.kind not in "iufb":
            raise InputError(
                f"{name}: expected '{key}' as {len(recorded)} numbers, found {values.dtype} of shape {values.shape}"
            )
        return np.asarray(values.reshape(-1)[there])

    points = recorded[there]
    distance = float(np.median(np.linalg.norm(points, axis=1)))
    if distance > FARTHEST_M:
        raise InputError(f"{name}: half of the returns are beyond {distance:.0f} m; expected metres (millimetres?)")
    ids = column(RING_NAMES)
    ring: Ints | None = None
    if ids is not None:
        ring = rings_of_ids(points, _integers(ids, name), sensor, name)
    elif sensor is not None:
        organised = _organised_ids(columns.height, len(recorded), sensor)
        if organised is not None:
            with contextlib.suppress(InputError):  # rows that are something else
                ring = rings_of_ids(points, organised[there], sensor, name)
        if ring is None:
            ring = rings_of_elevations(points, sensor, name)
    intensity, time = column(INTENSITY_NAMES), column(TIME_NAMES)
    return Scan(
        points,
        ring,
        None if intensity is None else intensity.astype(np.float64),
        None if time is None else _seconds(time, stamp, name),
        sensor,
        name,
    )


def _points(by_name: dict[str, NDArray[Any]], columns: Columns) -> Floats:
    """(N, 3) points, as recorded."""
    key = next((key for key in POINT_NAMES if key in by_name), None)
    if key is not None:
        points = by_name[key]
        if points.ndim < 2 or points.shape[-1] != 3 or points.dtype.kind not in "iuf":
            raise InputError(
                f"{columns.name}: '{key}' is {points.dtype} of shape {points.shape}, expected N x 3 numbers"
            )
        return points.reshape(-1, 3).astype(np.float64)
    if not {"x", "y", "z"} <= by_name.keys():
        found = ", ".join(list(columns.values)[:12]) or "none"
        raise InputError(f"{columns.name}: expected columns x, y, z or {', '.join(POINT_NAMES)}; found: {found}")
    axes = [by_name[axis].reshape(-1) for axis in "xyz"]
    if len({len(axis) for axis in axes}) > 1 or any(axis.dtype.kind not in "iuf" for axis in axes):
        raise InputError(f"{columns.name}: expected x, y, z as numbers, as many of each")
    return np.column_stack(axes).astype(np.float64)


def _organised_ids(height: int, n: int, sensor: SensorModel) -> Ints | None:
    """(n,) row, or column, of each point of an organised cloud that has as many as the sensor has rings."""
    if height <= 1 or n % height:
        return None
    rows, columns = np.divmod(np.arange(n), n // height)
    if height == sensor.n_rings:
        return rows
    return columns if n // height == sensor.n_rings else None


def _integers(ids: NDArray[Any], name: str) -> Ints:
    """Ring numbers as integers >= 0."""
    wrong = ~((ids >= 0) & (ids < 1 << 16))  # of NaN too
    if wrong.any() or (ids != ids.astype(np.int64)).any():
        bad = ids[wrong][0] if wrong.any() else ids[ids != ids.astype(np.int64)][0]
        raise InputError(f"{name}: expected ring numbers as integers from 0, found {bad}")
    return ids.astype(np.int64)


def _seconds(time: NDArray[Any], stamp: float | None, name: str) -> Floats | None:
    """(N,) per-point times as seconds relative to the scan's stamp.

    Times since the epoch are told by their size: about 1e18 are nanoseconds, 1e15 microseconds, 1e12 milliseconds, and
    1e9, as floats, seconds. They are counted from `stamp`, or from the earliest. Smaller numbers are relative to the
    stamp already: integers are nanoseconds (as Ouster's and Livox's drivers write them); floats are seconds unless the
    scan would last more than `LONGEST_SCAN_S`, then milli-, micro- or nanoseconds, the largest unit in which it does
    not. Where even those are far from the stamp they are of a clock of their own, and counted from the earliest.
    """
    floating = time.dtype.kind == "f"
    if floating and not (np.abs(time) < 1e20).all():  # False for NaN
        _LOG.warning("%s: times of points that are not times; read without them", name)
        return None
    if floating:
        time = time.astype(np.float64)
    first, duration = time.min(), float(time.max()) - float(time.min())
    for smallest, unit in _EPOCH_UNITS:
        if first >= smallest and duration * unit <= LONGEST_SCAN_S and (floating or unit < 1):
            offset = 0.0 if stamp is None else float(first) * unit - stamp
            return np.asarray((time - first) * unit + offset)
    units = (1.0, 1e-3, 1e-6) if floating else ()
    unit = next((unit for unit in units if duration * unit <= LONGEST_SCAN_S), 1e-9)
    own_clock = abs(float(first)) * unit > LONGEST_SCAN_S
    return np.asarray((time - first if own_clock else time) * unit)
