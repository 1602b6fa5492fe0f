"""The scan: LiDAR returns with their rings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Floats, Ints, Value, brief, frozen
from optshape_graph.errors import InputError
from optshape_graph.sensor import SensorModel

Values = TypeVar("Values", Floats | None, Ints | None)


@dataclass(frozen=True, eq=False)
class Scan(Value):
    """Returns of one LiDAR, of one revolution or part of it.

    Attributes:
        points: (N, 3) metres, LiDAR frame, all finite.
        ring: (N,) ring of each return, counted from the lowest elevation; None: the cloud has no rings.
        intensity: (N,) as recorded, or None.
        time: (N,) seconds, relative to the scan's stamp, or None.
        sensor: the sensor that made it, if known.
        name: where it came from, for messages.

    Raises:
        InputError: shapes that do not fit, or points that are not finite.
    """

    points: Floats
    ring: Ints | None = None
    intensity: Floats | None = None
    time: Floats | None = None
    sensor: SensorModel | None = None
    name: str = "scan"

    def __post_init__(self) -> None:
        points = frozen(self.points)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"{self.name}: expected points as N x 3, found shape {points.shape}")
        if not np.isfinite(points).all():
            raise InputError(f"{self.name}: {int((~np.isfinite(points).all(axis=1)).sum())} points are not finite")
        object.__setattr__(self, "points", points)
        for field, dtype in (("ring", np.int64), ("intensity", np.float64), ("time", np.float64)):
            values = getattr(self, field)
            if values is None:
                continue
            values = frozen(values, dtype)
            if values.shape != (len(points),):
                raise InputError(f"{self.name}: {len(points)} points but {field} of shape {values.shape}")
            object.__setattr__(self, field, values)

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        rings = "" if self.ring is None else f", {len(np.unique(self.ring))} rings"
        return f"Scan({brief(self.name)}, {len(self)} returns{rings})"

    def select(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> Scan:
        """Return the returns that a mask (N,) or an index array (M,) picks, with all their fields."""

        def pick(values: Values) -> Values:
            return None if values is None else values[index]

        return replace(
            self,
            points=self.points[index],
            ring=pick(self.ring),
            intensity=pick(self.intensity),
            time=pick(self.time),
        )


def without_duplicates(scan: Scan) -> tuple[Scan, int]:
    """Return a scan without exact copies of returns, and the number of copies.

    A driver that reports two returns for each firing repeats a return that was the only one.
    """
    if len(scan) < 2:
        return scan, 0
    order = np.lexsort(scan.points.T)
    again = (np.diff(scan.points[order], axis=0) == 0).all(axis=1)
    if scan.ring is not None:
        again &= np.diff(scan.ring[order]) == 0
    if not again.any():
        return scan, 0
    keep = np.ones(len(scan), dtype=bool)
    keep[order[1:][again]] = False
    return scan.select(keep), int(again.sum())


def put_right(scan: Scan) -> Scan:
    """Return a scan corrected for the known deviations of its sensor's rings in range, elevation and azimuth.

    The sensor of the returned scan has none of these deviations, so correcting it again changes nothing.
    """
    sensor = scan.sensor
    if sensor is None or scan.ring is None or sensor.put_right is sensor:
        return scan
    return replace(scan, points=moved(scan.points, scan.ring, *sensor.deviations), sensor=sensor.put_right)


def moved(points: Floats, ring: Ints, range_bias: Floats, elevation: Floats, azimuth: Floats) -> Floats:
    """Return points (N, 3), metres, with their rings' ranges shortened and their directions turned.

    Args:
        points: (N, 3) metres, LiDAR frame.
        ring: (N,) of each.
        range_bias: (R,) metres by which ranges are shortened.
        elevation: (R,) rad by which directions are raised.
        azimuth: (R,) rad by which they are turned to the left.
    """
    x, y, z = points.T
    flat = np.hypot(x, y)
    r = np.hypot(flat, z) - range_bias[ring]
    up = np.arctan2(z, flat) + elevation[ring]
    left = np.arctan2(y, x) + azimuth[ring]
    return np.column_stack([r * np.cos(up) * np.cos(left), r * np.cos(up) * np.sin(left), r * np.sin(up)])


def rings_missing(scan: Scan) -> InputError:
    """Return the error for a scan without rings in which targets are to be found; its message says what to do."""
    return InputError(
        f"{scan.name}: its returns have no rings, and targets are found ring by ring; expected a ring for each, or the "
        "sensor whose table tells (--sensor). Livox and flash LiDARs have none: cut the target's returns out and use "
        "`optshape estimate`"
    )
