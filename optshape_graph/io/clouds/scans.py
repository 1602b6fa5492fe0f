"""Scans made of columns: which columns are points, rings and times, in which units, and which rows are not returns."""

from __future__ import annotations

import contextlib
import logging
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from types import NoneType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Bools, Floats, Ints, owned
from optshape_graph.errors import InputError, expect
from optshape_graph.io.clouds.columns import Columns, Role, roles
from optshape_graph.io.clouds.rings import rings_by_firing, rings_of_elevations, rings_of_ids
from optshape_graph.io.times import seconds_of_points
from optshape_graph.scan import NO_RETURN_M, Scan, not_in_metres, put_right, ring_numbers
from optshape_graph.sensor import SensorModel

_LOG = logging.getLogger(__name__)

NOISE_TAGS = 0b0101
"""Bits of Livox's tag that mark noise, by the position of a return among others and by its intensity."""


def make_scan(
    columns: Columns,
    sensor: SensorModel | None = None,
    stamp: float | None = None,
    unused: Counter[str] | None = None,
) -> Scan:
    """Make a scan of a cloud's columns.

    - Columns are recognised by many names (`columns.KNOWN`) in any case; a unit in the name counts.
    - Points are `x`, `y`, `z`, or one array (N x 3), in metres.
    - Points that are not finite, exactly at the origin, or beyond `NO_RETURN_M` are not returns: they are dropped with
      all their fields, and so are returns that a Livox marks as noise (`NOISE_TAGS`).
    - Rings are a column of any integer type, or of floats that hold integers. Without one, they come from the order of
      firing, if the file keeps it; from the rows (or columns) of an organised cloud, if it has as many as the sensor
      has rings; or from the elevations, if the sensor is known. However a driver numbers them, rings are counted from
      the lowest elevation, and are rows of the table of a known sensor (see `rings`). Livox's lines, which come with a
      tag, are not rings.
    - Returns are corrected by a calibrated sensor's file (`put_right`).
    - The unit of times follows from name, type and size (see `times.seconds_of_points`).

    Args:
        columns: a file's or a message's columns.
        sensor: the sensor that made the cloud, if known.
        stamp: the scan's own time, seconds since the epoch, from which absolute times of points are counted; None:
            from the earliest.
        unused: counter, by name, of columns that do not go into the scan.

    Raises:
        InputError: no returns, columns of different lengths, millimetres, map coordinates, rings that are not integers,
            a sensor that is no SensorModel, or whose table does not fit the elevations.
    """
    return use_up(replace(columns, values=dict(columns.values)), sensor, stamp, unused)


@np.errstate(invalid="ignore", over="ignore")  # for signalling NaNs and absurd numbers in a file
def use_up(
    columns: Columns,
    sensor: SensorModel | None = None,
    stamp: float | None = None,
    unused: Counter[str] | None = None,
) -> Scan:
    """Make a scan as `make_scan` does, and take the columns out that became part of it: none is in memory twice.

    Args:
        columns: a file's, of which nobody else has need.
        sensor: as for `make_scan`.
        stamp: as for `make_scan`.
        unused: as for `make_scan`.

    Raises:
        InputError: as `make_scan`.
    """
    expect("sensor", sensor, SensorModel, NoneType)
    name, names = columns.name, (*columns.values, *columns.left_out)
    try:
        known = roles(columns.values)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    points = _points(known, columns)
    recorded = len(points)
    squared = np.einsum("ij,ij->i", points, points)  # of the ranges
    there = (squared > 0) & (squared < NO_RETURN_M**2)  # False for NaN
    if not there.any():
        raise InputError(f"{name}: no returns ({recorded} points, all at the origin, not finite, or out of reach)")
    there = _without_noise(known, columns, there)
    whole = bool(there.all())

    def column(role: str) -> NDArray[Any] | None:
        if role not in known:
            return None
        key = known[role].column
        values = columns.values.pop(key)
        if values.ndim != 1 and values.size != recorded:
            return None  # a matrix, or one number, beside the cloud
        if values.size != recorded or values.dtype.kind not in "iufb":
            raise InputError(
                f"{name}: expected '{key}' as {recorded} numbers, found {values.dtype} of shape {values.shape}"
            )
        return np.asarray(values.reshape(-1) if whole else values.reshape(-1)[there])

    if not whole:
        points, squared = points[there], squared[there]
    if objection := not_in_metres(points, squared):
        raise InputError(f"{name}: {objection}")
    del squared  # memory limits the size of clouds
    ring = _rings(columns, None if is_livox(known) else column("ring"), points, there, sensor)
    intensity, time = column("intensity"), column("time")
    seconds = None
    if time is not None:
        seconds = seconds_of_points(time, known["time"].unit, stamp, points)
        if seconds is None:
            _LOG.warning("%s: times of points that are not times; read without them", name)
    if unused is not None:
        unused.update(unused_columns(names, known, seconds is not None))
    scan = Scan(
        owned(points, np.float64),
        owned(ring, np.int64),
        None if intensity is None else owned(intensity.astype(np.float64), np.float64),
        owned(seconds, np.float64),
        sensor,
        name,
    )
    return put_right(scan)


def unused_columns(names: Iterable[str], known: dict[str, Role], with_times: bool) -> list[str]:
    """Return the names of columns that do not go into the scan."""
    tags = is_livox(known)
    used = {
        role.column
        for what, role in known.items()
        if (what != "time" or with_times) and (what != "tag" or tags) and (what != "xyz" or "x" not in known)
    }
    return [name for name in names if name not in used]


def is_livox(known: dict[str, Role]) -> bool:
    """Return whether the columns are those of a Livox: a tag beside the laser's line."""
    return "tag" in known and "ring" in known and known["ring"].column.lower() == "line"


def _rings(
    columns: Columns, ids: NDArray[Any] | None, points: Floats, there: Bools, sensor: SensorModel | None
) -> Ints | None:
    name = columns.name
    if ids is not None:
        return rings_of_ids(points, ring_numbers(ids, name), sensor, name)
    if columns.fired:
        fired = rings_by_firing(points, sensor, name)
        if fired is not None:
            return fired
    if sensor is None:
        return None
    organised = _organised_ids(columns.height, len(there), sensor)
    if organised is not None:
        with contextlib.suppress(InputError):  # rows that are something else
            return rings_of_ids(points, organised[there], sensor, name)
    return rings_of_elevations(points, sensor, name)


def _without_noise(known: dict[str, Role], columns: Columns, there: Bools) -> Bools:
    """Leave out returns that a Livox marks as noise."""
    if not is_livox(known):
        return there
    tags = columns.values[known["tag"].column].reshape(-1)
    if tags.shape != there.shape or tags.dtype.kind not in "iuf":
        return there
    noise = there & ((tags.astype(np.int64) & NOISE_TAGS) != 0)
    if not noise.any() or (noise == there).all():
        return there
    _LOG.info("%s: %d of %d returns left out, which the sensor marks as noise", columns.name, noise.sum(), there.sum())
    return np.asarray(there & ~noise)


def _points(known: dict[str, Role], columns: Columns) -> Floats:
    """Take the columns of the points out, and return a copy of these (N, 3), metres."""
    values, name = columns.values, columns.name
    if {"x", "y", "z"} <= known.keys():
        axes = [values.pop(known[axis].column).reshape(-1) for axis in "xyz"]
        if len({len(axis) for axis in axes}) > 1 or any(axis.dtype.kind not in "iuf" for axis in axes):
            raise InputError(f"{name}: expected x, y, z as numbers, as many of each")
        points = np.empty((len(axes[0]), 3))
        for i, (axis, key) in enumerate(zip(axes, "xyz", strict=True)):
            points[:, i] = axis
            if known[key].unit is not None:
                points[:, i] *= _scale(known[key])
        return points
    if "xyz" not in known:
        found = ", ".join(list(values)[:24]) or "none"
        raise InputError(f"{name}: expected columns x, y, z, or one of N x 3 called xyz or points; found: {found}")
    key = known["xyz"].column
    rows = values.pop(key)
    if rows.ndim < 2 or rows.shape[-1] != 3 or rows.dtype.kind not in "iuf":
        raise InputError(f"{name}: '{key}' is {rows.dtype} of shape {rows.shape}, expected N x 3 numbers")
    return rows.reshape(-1, 3).astype(np.float64) * _scale(known["xyz"])


def _scale(role: Role) -> float:
    return 1.0 if role.unit is None else role.unit


def _organised_ids(height: int, n: int, sensor: SensorModel) -> Ints | None:
    """Return the row (n,), or column, of each point of an organised cloud that has as many as the sensor has rings."""
    if height <= 1 or n % height:
        return None
    rows, columns = np.divmod(np.arange(n), n // height)
    if height == sensor.n_rings:
        return rows
    return columns if n // height == sensor.n_rings else None
