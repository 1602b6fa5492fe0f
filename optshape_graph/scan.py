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
    """Return a scan with each return once, and how many exact copies were dropped.

    A driver that reports two returns of each firing repeats the one where there was no other. It says nothing new.
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


def rings_missing(scan: Scan) -> InputError:
    """Return the error that a scan, in which targets are to be found, has no rings; it says what can be done."""
    return InputError(
        f"{scan.name}: its returns have no rings, and targets are found ring by ring; expected a ring for each, or the "
        "sensor whose table tells (--sensor). Livox and flash LiDARs have none: cut the target's returns out and use "
        "`optshape estimate`"
    )
