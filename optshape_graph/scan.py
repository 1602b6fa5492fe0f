"""The scan: LiDAR returns with their rings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import NoneType
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optshape_graph._arrays import Floats, Ints, Value, brief, numbers
from optshape_graph.errors import InputError, expect
from optshape_graph.sensor import SensorModel

Values = TypeVar("Values", Floats | None, Ints | None)

AT_SENSOR_M, NO_RETURN_M = 1e-3, 1e7
"""Nearer than the first, metres, and from the second on, a point is not a return: some drivers write 0, or the largest
number, where nothing came back."""

FARTHEST_M = 500.0
"""No LiDAR's median return is farther, metres; such a cloud is in millimetres or in a map's coordinates."""

MAP_M = 1e5
"""From this distance on, metres, coordinates are a map's: as millimetres they would be 100 m."""

LEVEL = np.radians(0.1)
"""By less than this, rad, and four standard errors, elevations of two rings may be in the wrong order."""


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
        InputError: shapes that do not fit, points that are not finite, ring numbers that are not integers from 0, or
            that the sensor does not have.
    """

    points: Floats
    ring: Ints | None = None
    intensity: Floats | None = None
    time: Floats | None = None
    sensor: SensorModel | None = None
    name: str = "scan"

    def __post_init__(self) -> None:
        expect(f"{self.name}: sensor", self.sensor, SensorModel, NoneType)
        points = numbers(f"{self.name}: points", self.points)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"{self.name}: expected points as N x 3, found shape {points.shape}")
        if not np.isfinite(points).all():
            raise InputError(f"{self.name}: {int((~np.isfinite(points).all(axis=1)).sum())} points are not finite")
        object.__setattr__(self, "points", points)
        for field in ("ring", "intensity", "time"):
            values = getattr(self, field)
            if values is None:
                continue
            values = ring_numbers(values, self.name) if field == "ring" else numbers(f"{self.name}: {field}", values)
            if values.shape != (len(points),):
                raise InputError(f"{self.name}: {len(points)} points but {field} of shape {values.shape}")
            object.__setattr__(self, field, values)
        sensor = self.sensor
        if self.ring is not None and sensor is not None and self.ring.max(initial=0) >= sensor.n_rings:
            raise InputError(
                f"{self.name}: ring {self.ring.max()}, but sensor '{sensor.name}' has {sensor.n_rings}, "
                "counted from 0 for the lowest"
            )

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        rings = "" if self.ring is None else f", {len(np.unique(self.ring))} rings"
        return f"Scan({brief(self.name)}, {len(self)} returns{rings})"

    def select(self, index: NDArray[np.bool_] | NDArray[np.int64], points: Floats | None = None) -> Scan:
        """Return the returns that a mask (N,) or an index array (M,) picks, with all their fields.

        Args:
            index: a mask (N,), or numbers of returns (M,).
            points: (M, 3) where they are now, metres; None: where they were.
        """

        def pick(values: Values) -> Values:
            return None if values is None else values[index]

        return replace(
            self,
            points=self.points[index] if points is None else points,
            ring=pick(self.ring),
            intensity=pick(self.intensity),
            time=pick(self.time),
        )


def without_duplicates(scan: Scan) -> tuple[Scan, int]:
    """Return a scan without exact copies of returns, and the number of copies.

    A driver that reports two returns for each firing repeats a return that was the only one.
    """
    x, y, z = scan.points.T
    sums = np.sort(x + np.sqrt(2) * y + np.sqrt(3) * z)
    if (sums[1:] > sums[:-1]).all():  # copies have equal ones
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


def only_returns(scan: Scan) -> Scan:
    """Return a scan without the points that are no returns: at the sensor, or beyond `NO_RETURN_M`."""
    largest = np.abs(scan.points).max(axis=1, initial=0.0)
    there = (largest > AT_SENSOR_M) & (largest < NO_RETURN_M)
    return scan if there.all() else scan.select(there)


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


def ring_numbers(ids: ArrayLike, name: str) -> Ints:
    """Return ring numbers (N,) as a read-only array of integers.

    Raises:
        InputError: a number that is negative, too large, or not an integer; `name` is the scan's.
    """
    found = np.asarray(ids)
    if found.dtype.kind not in "biuf":
        found = numbers(f"{name}: ring", ids)
    wrong = ~((found >= 0) & (found < 1 << 16))  # of NaN too
    if found.dtype.kind == "f":
        wrong |= found != np.trunc(found)
    if wrong.any():
        raise InputError(f"{name}: expected ring numbers as integers from 0, found {found[wrong][0]}")
    return numbers(f"{name}: ring", found, np.int64)


def not_in_metres(points: Floats, squared: Floats | None = None) -> str:
    """Return what shows that points are in millimetres, or in coordinates of a map; "" for returns as they should be.

    Args:
        points: (N, 3) what are to be metres, LiDAR frame.
        squared: (N,) squares of their ranges, if known: of metres too.
    """
    if squared is None:
        squared = np.einsum("ij,ij->i", points, points)
    if 2 * np.count_nonzero(squared > FARTHEST_M**2) < max(len(points), 1):
        return ""
    distance = float(np.sqrt(np.median(squared)))
    centre = np.median(points, axis=0)
    spread = float(np.median(np.linalg.norm(points - centre, axis=1)))
    far = f"half of the returns are beyond {distance:.0f} m; expected metres"
    if float(np.linalg.norm(centre)) < spread:  # they are all around
        return f"{far} (millimetres? a CSV may say so: 'x (mm)')"
    if distance > MAP_M:
        return (
            f"half of the returns are within {spread:.0f} m of ({centre[0]:.0f}, {centre[1]:.0f}, {centre[2]:.0f}): "
            "coordinates of a map (UTM, ...); expected metres from the LiDAR, as it measured them"
        )
    return f"{far} from the LiDAR (millimetres, or coordinates of a map?)"


def rings_missing(scan: Scan) -> InputError:
    """Return the error for a scan without rings in which targets are to be found; its message says what to do."""
    return InputError(
        f"{scan.name}: its returns have no rings, and targets are found ring by ring; expected a ring for each, or the "
        "sensor whose table tells (--sensor). Livox and flash LiDARs have none: cut the target's returns out and use "
        "`optshape estimate`"
    )


def elevations_of(points: Floats) -> Floats:
    """Return the elevations (N,), rad, of points (N, 3), metres, LiDAR frame."""
    x, y, z = points.T
    return np.asarray(np.arctan2(z, np.hypot(x, y)))


def rings_from_the_top(scan: Scan) -> str:
    """Return what shows that a scan's ring numbers fall with elevation; "" where they rise, or there are none."""
    if scan.ring is None or len(scan) == 0:
        return ""
    low, high = int(scan.ring.min()), int(scan.ring.max())
    of_low, of_high = (elevations_of(scan.points[np.flatnonzero(scan.ring == one)]) for one in (low, high))
    lowest, highest = float(np.mean(of_low)), float(np.mean(of_high))
    error = float(np.sqrt(np.var(of_low) / len(of_low) + np.var(of_high) / len(of_high)))
    if highest > lowest - LEVEL - 4.0 * error:
        return ""
    return (
        f"ring {high} looks at {np.degrees(highest):.2f} deg, ring {low} at {np.degrees(lowest):.2f} deg; expected "
        "rings that are counted from the lowest elevation, as `read_scan` counts them"
    )
