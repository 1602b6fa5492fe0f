"""Edge points: the returns at the two ends of each ring on a target.

A ring's last return on the target lies inside the true edge by part of an azimuth step, so an edge point
carries the direction along its ring in which the edge is to be looked for (`outward`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints, frozen
from optshape_graph.errors import EstimationError
from optshape_graph.scan import Scan

LEFT, RIGHT = 1, -1
"""Ends of a ring: the largest azimuth (left, seen from the sensor) and the smallest."""


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Both ends of every ring on one target, rings from the lowest up, left end before right end.

    A ring with a single return has two coinciding edge points: the target ends on both sides of it.

    Attributes:
        points: (M, 3) metres, LiDAR frame.
        ring: (M,) ring index, counted from the lowest elevation.
        side: (M,) LEFT (+1) or RIGHT (-1).
        azimuth: (M,) rad, relative to `reference_azimuth`, increasing to the left.
        index: (M,) row of the scan that each point is.
        revolutions: (M,) how many revolutions were merged in the point's ring.
        reference_azimuth: azimuth of the target's returns in the LiDAR frame, rad.
        azimuth_step: rad between two firings of a beam in one revolution.
    """

    points: Floats
    ring: Ints
    side: Ints
    azimuth: Floats
    index: Ints
    revolutions: Ints
    reference_azimuth: float
    azimuth_step: float

    def __post_init__(self) -> None:
        for field, dtype in (
            ("points", np.float64), ("azimuth", np.float64), ("ring", np.int64),
            ("side", np.int64), ("index", np.int64), ("revolutions", np.int64),
        ):  # fmt: skip
            object.__setattr__(self, field, frozen(getattr(self, field), dtype))

    def __len__(self) -> int:
        return len(self.points)

    @property
    def n_rings(self) -> int:
        """Number of rings that hit the target."""
        return len(self) // 2

    def outward(self, normal: Floats) -> Floats:
        """Motion of each point along its ring, away from the target's inside, per radian of azimuth.

        Args:
            normal: (3,) normal of the target's plane, LiDAR frame.

        Returns:
            (M, 3) metres per radian, in the plane: side * (z x p - p (n . (z x p)) / (n . p)).
        """
        turning = np.column_stack([-self.points[:, 1], self.points[:, 0], np.zeros(len(self))])
        along = turning - self.points * ((turning @ normal) / (self.points @ normal))[:, None]
        return np.asarray(along * self.side[:, None])


def relative_azimuth(points: Floats) -> tuple[Floats, float]:
    """Azimuths of returns relative to their mean direction, right across the +-180 degree seam.

    Args:
        points: (N, 3) metres, LiDAR frame.

    Returns:
        (N,) rad in (-pi, pi], and the azimuth of the mean direction, rad.
    """
    direction = points[:, 0] + 1j * points[:, 1]
    direction = direction / np.maximum(np.abs(direction), 1e-12)
    reference = float(np.angle(direction.sum()))
    return np.angle(direction * np.exp(-1j * reference)), reference


def azimuth_spacing(azimuth: Floats, ring: Ints) -> float | None:
    """Median azimuth between neighbouring returns of a ring, rad; None where no ring has two returns."""
    order = np.lexsort((azimuth, ring))
    gaps = np.diff(azimuth[order])[np.diff(ring[order]) == 0]
    gaps = gaps[gaps > 1e-6]
    return float(np.median(gaps)) if len(gaps) else None


def extract_edge_points(scan: Scan) -> EdgePoints:
    """Find both ends of each ring, by azimuth.

    The azimuth step is the sensor's; where it does not state one, the median spacing of the returns.

    Args:
        scan: the returns of one target, with rings.

    Raises:
        EstimationError: no returns, no rings, or no azimuth step stated and none to be seen.
    """
    if len(scan) == 0:
        raise EstimationError(f"{scan.name}: no returns on the target")
    if scan.ring is None:
        raise EstimationError(f"{scan.name}: edge points need rings, and the cloud has none")
    azimuth, reference = relative_azimuth(scan.points)
    spacing = azimuth_spacing(azimuth, scan.ring)
    step = scan.sensor.azimuth_step if scan.sensor else None
    if step is None:
        step = spacing
    if step is None:
        raise EstimationError(f"{scan.name}: the sensor states no azimuth step, and no ring has two returns")

    order = np.lexsort((-azimuth, scan.ring))
    ring = scan.ring[order]
    first = np.flatnonzero(np.diff(ring, prepend=ring[0] - 1))
    last = np.append(first[1:], len(ring)) - 1
    index = np.column_stack([order[first], order[last]]).ravel()

    span = azimuth[order[first]] - azimuth[order[last]]
    density = (last - first) * step / np.maximum(span, step)
    revolutions = np.maximum(np.rint(density), 1)
    if spacing is not None and spacing > 0.75 * step:
        revolutions[:] = 1  # gaps and jitter make single rings look denser than they are
    return EdgePoints(
        points=scan.points[index],
        ring=scan.ring[index],
        side=np.tile([LEFT, RIGHT], len(first)),
        azimuth=azimuth[index],
        index=index,
        revolutions=np.repeat(revolutions, 2).astype(np.int64),
        reference_azimuth=reference,
        azimuth_step=step,
    )
