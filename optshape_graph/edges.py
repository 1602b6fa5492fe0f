"""Edge points: the returns at the two ends of each ring on a target.

A ring's last return on the target lies inside the true edge by part of an azimuth step. So an edge point comes with the
direction along its ring in which the edge lies (`outward`), and with the interval in which it lies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value, frozen
from optshape_graph.errors import EstimationError
from optshape_graph.groups import Groups
from optshape_graph.ring_returns import RingReturns, relative_azimuths
from optshape_graph.scan import Scan

LEFT, RIGHT = 1, -1
"""Ends of a ring: the largest azimuth (left, seen from the sensor) and the smallest."""

UP, DOWN = 2, -2
"""Returns of the highest and of the lowest ring, beyond which the next ring has none."""

KNOWN_LOST = (10.0, 0.4)
"""Prior of `lost_rings`: so many rings met a target, and so many of them were lost. One in 25 is, on recordings."""


@dataclass(frozen=True, eq=False, repr=False)
class EdgePoints(Value):
    """Both ends of every ring on one target, rings from the lowest up, left end before right end.

    A ring with a single return has two coinciding edge points: the target ends on both sides of it.

    Attributes:
        points: (M, 3) metres, LiDAR frame.
        ring: (M,) ring index, counted from the lowest elevation.
        side: (M,) LEFT or RIGHT; UP or DOWN for points that `with_top_and_bottom` adds.
        azimuth: (M,) rad, relative to `reference_azimuth`, increasing to the left.
        index: (M,) row of the scan that each point is.
        revolutions: (M,) how many revolutions were merged in the point's ring.
        lower: (M,) lower end of the interval of the boundary, an angle outwards from each point, rad. It is 0; negative
            where a gap separates the point from the rest of its ring, since it may be a stray.
        upper: (M,) upper end of that interval, rad: a step, for one revolution.
        scatter: (M,) standard deviation of the interval's place, independent for each point, rad; 0 for exact azimuths.
        shift: (M,) standard deviation of the place of a whole ring, which moves both its ends the same way, rad; 0 for
            exact azimuths.
        reference_azimuth: azimuth of the target's returns in the LiDAR frame, rad.
        azimuth_step: rad between two firings of a beam in one revolution.
    """

    points: Floats
    ring: Ints
    side: Ints
    azimuth: Floats
    index: Ints
    revolutions: Ints
    lower: Floats
    upper: Floats
    scatter: Floats
    shift: Floats
    reference_azimuth: float
    azimuth_step: float

    def __post_init__(self) -> None:
        for field in ("points", "azimuth", "lower", "upper", "scatter", "shift"):
            object.__setattr__(self, field, frozen(getattr(self, field)))
        for field in ("ring", "side", "index", "revolutions"):
            object.__setattr__(self, field, frozen(getattr(self, field), np.int64))

    @classmethod
    def none(cls) -> EdgePoints:
        """Return no edge points, for a cloud without rings."""
        counts, angles = np.zeros(0, dtype=np.int64), np.zeros(0)
        return cls(
            points=np.zeros((0, 3)), ring=counts, side=counts, azimuth=angles, index=counts, revolutions=counts,
            lower=angles, upper=angles, scatter=angles, shift=angles, reference_azimuth=0.0, azimuth_step=0.0,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.points)

    @property
    def width(self) -> Floats:
        """(M,) width of the interval in which the boundary lies, rad."""
        return np.asarray(self.upper - self.lower)

    @property
    def middle(self) -> Floats:
        """(M,) azimuth beyond each point at which the boundary is expected, rad."""
        return np.asarray(0.5 * (self.lower + self.upper))

    @property
    def noisy(self) -> bool:
        """Whether azimuths have noise."""
        return bool((self.scatter > 0).any() or (self.shift > 0).any())

    @property
    def n_rings(self) -> int:
        """Number of rings that hit the target."""
        return int(np.count_nonzero(np.abs(self.side) < UP)) // 2

    @property
    def lost_rings(self) -> float:
        """Share of rings that meet the target but return nothing, by those between the lowest and the highest."""
        between = self.ring.max() - self.ring.min() + 1
        tried, lost = KNOWN_LOST
        return float((between - self.n_rings + lost) / (between + tried))

    def outward(self, normal: Floats) -> Floats:
        """Return the outward motion of each point in the target's plane, per radian of azimuth (or elevation).

        Args:
            normal: (3,) normal of the target's plane, LiDAR frame.

        Returns:
            (M, 3) metres per radian, s - p (n . s) / (n . p) with s = `sweep`.
        """
        return np.asarray(self.sweep - self.points * ((self.sweep @ normal) / (self.points @ normal))[:, None])

    @cached_property
    def sweep(self) -> Floats:
        """(M, 3) motion of each point, outwards, as its ray turns at constant range, metres per radian.

        Along the ring it is +-(z x p), across the rings +-(p x (z x p)) / |z x p|.
        """
        along = np.where(np.abs(self.side)[:, None] == LEFT, leftward(self.points), upward(self.points))
        return frozen(along * np.sign(self.side)[:, None])


def leftward(points: Floats) -> Floats:
    """Return the motion (..., 3), metres per radian, of points (..., 3) as their azimuth grows."""
    moved = np.zeros(points.shape)
    moved[..., 0], moved[..., 1] = -points[..., 1], points[..., 0]
    return moved


def upward(points: Floats) -> Floats:
    """Return the motion (..., 3), metres per radian, of points (..., 3) as their elevation grows at constant range."""
    flat, moved = np.hypot(points[..., 0], points[..., 1]), np.empty(points.shape)
    moved[..., :2], moved[..., 2] = points[..., :2] * (-points[..., 2] / flat)[..., None], flat
    return moved


def relative_azimuth(points: Floats) -> tuple[Floats, float]:
    """Return the azimuths (N,) of one scan's returns (N, 3), metres, as `relative_azimuths` does, and the reference."""
    azimuth, reference = relative_azimuths(points, Groups.of([points]))
    return azimuth, float(reference[0])


def azimuth_spacing(azimuth: Floats, ring: Ints) -> float | None:
    """Return the median azimuth between neighbouring returns of a ring, rad; None if no ring has two returns.

    Args:
        azimuth: (N,) of each return, rad.
        ring: (N,) of each return.
    """
    order = np.lexsort((azimuth, ring))
    gaps = np.diff(azimuth[order])[np.diff(ring[order]) == 0]
    gaps = gaps[gaps > 1e-6]
    return float(np.median(gaps)) if len(gaps) else None


def extract_edge_points(scan: Scan) -> EdgePoints:
    """Find both ends of each ring, by azimuth; see `edge_points`.

    Args:
        scan: the returns of one target, with rings.

    Raises:
        EstimationError: no returns, no rings, or no azimuth step, neither stated nor seen.
    """
    if len(scan) == 0:
        raise EstimationError(f"{scan.name}: no returns on the target")
    if scan.ring is None:
        raise EstimationError(f"{scan.name}: edge points need rings, and the cloud has none")
    (edges,) = edge_points(RingReturns.of([scan]))
    if isinstance(edges, EstimationError):
        raise edges
    return edges


def edge_points(returns: RingReturns) -> list[EdgePoints | EstimationError]:
    """Find both ends of each ring of B scans, by azimuth.

    The azimuth step is the sensor's, or the median spacing of the returns if the sensor states none.

    Returns:
        For each scan its edge points; or the error, where a step is neither stated nor seen.
    """
    azimuth, rings, rings_of_scan = returns.azimuth, returns.rings, returns.rings_of_scan
    spacing = returns.scans.median(returns.gap, returns.gap > 1e-6)
    stated = [None if sensor is None else sensor.azimuth_step for sensor in returns.sensors]
    steps = np.where([step is None for step in stated], spacing, [step or 0.0 for step in stated])
    step = np.where(np.isfinite(steps), steps, 1.0)

    step_of, first, last = rings_of_scan.each(step), rings.first, rings.last
    density = (rings.counts - 1) * step_of / np.maximum(azimuth[first] - azimuth[last], step_of)
    revolutions = np.maximum(np.rint(density), 1)
    # Gaps and jitter make single rings look denser than they are.
    revolutions[rings_of_scan.each(np.isfinite(spacing) & (spacing > 0.75 * step))] = 1
    index = np.column_stack([first, last]).ravel()
    points, at, row = returns.points[index], azimuth[index], returns.row[index]
    ring, revolutions = np.repeat(returns.ring, 2), np.repeat(revolutions, 2)
    lower = -_parted(azimuth, first, last, step_of)
    upper = extreme_width(revolutions) * np.repeat(step_of, 2)
    found: list[EdgePoints | EstimationError] = []
    for number, (scan, rows) in enumerate(zip(returns.made_from, rings_of_scan.slices, strict=True)):
        if not np.isfinite(steps[number]):
            found.append(
                EstimationError(f"{scan.name}: the sensor states no azimuth step, and no ring has two returns")
            )
            continue
        ends = slice(2 * rows.start, 2 * rows.stop)
        nothing = np.zeros(ends.stop - ends.start)
        found.append(
            EdgePoints(
                points=points[ends], ring=ring[ends], side=np.tile([LEFT, RIGHT], len(nothing) // 2), azimuth=at[ends],
                index=row[ends], revolutions=revolutions[ends].astype(np.int64), lower=lower[ends], upper=upper[ends],
                scatter=nothing, shift=nothing, reference_azimuth=float(returns.reference[number]),
                azimuth_step=float(step[number]),
            )
        )  # fmt: skip
    return found


PARTED = 2.5
"""Gap, in steps of azimuth, beyond which a ring's outermost returns may be strays: two firings are missing. Most such
ends of one recorded sensor lie outside the target, those of another on its rim."""


def _parted(azimuth: Floats, first: Ints, last: Ints, step: Floats) -> Floats:
    """Return the angle (M,) from each end of a ring inwards across a gap after its first or second return; 0: no gap.

    Args:
        azimuth: (N,) of the returns, ring by ring, falling within each, rad.
        first: (R,) row of each ring's left end.
        last: (R,) row of its right end.
        step: (R,) rad.
    """
    end, other = np.stack([first, last]), np.stack([last, first])
    inwards = np.array([[1], [-1]])
    across = np.zeros(end.shape)
    for k in (1, 2):
        inner = end + inwards * k
        there = inwards * (other - inner) > 0  # a ring of strays alone has no rest
        inner = np.where(there, inner, end)
        angle = np.abs(azimuth[end] - azimuth[inner])
        gap = np.abs(azimuth[np.where(there, inner - inwards, end)] - azimuth[inner])
        across = np.where(gap > PARTED * step, angle, across)
    return across.T.ravel()


def with_top_and_bottom(edges: EdgePoints, returns: RingReturns) -> EdgePoints:
    """Add a return of the highest ring and one of the lowest, since the target ends before the next ring.

    Each is from the middle of its ring. Nothing is added where the sensor has no further ring, or is unknown.

    Args:
        edges: both ends of each ring.
        returns: of the one scan that they were found in.
    """
    (sensor,) = returns.sensors
    if sensor is None:
        return edges
    elevations, middle = sensor.elevations, returns.rings.last - returns.rings.counts // 2
    beyond = [(-1, edges.ring[-1] + 1, UP), (0, edges.ring[0] - 1, DOWN)]
    beyond = [(of, following, way) for of, following, way in beyond if 0 <= following < len(elevations)]
    row, ring = middle[[of for of, _, _ in beyond]], returns.ring[[of for of, _, _ in beyond]]
    ends, nothing = [following for _, following, _ in beyond], np.zeros(len(beyond))
    return replace(
        edges,
        points=np.concatenate([edges.points, returns.points[row]]),
        ring=np.concatenate([edges.ring, ring]),
        side=np.concatenate([edges.side, np.array([way for _, _, way in beyond], dtype=np.int64)]),
        azimuth=np.concatenate([edges.azimuth, returns.azimuth[row]]),
        index=np.concatenate([edges.index, returns.row[row]]),
        revolutions=np.concatenate([edges.revolutions, np.ones(len(beyond), dtype=np.int64)]),
        lower=np.concatenate([edges.lower, nothing]),
        upper=np.concatenate([edges.upper, np.abs(elevations[ends] - elevations[ring])]),
        scatter=np.concatenate([edges.scatter, nothing]),
        shift=np.concatenate([edges.shift, nothing]),
    )


def extreme_width(revolutions: Floats) -> Floats:
    """Return how far beyond a ring's last return the boundary may lie, in azimuth steps (R,).

    That is one step for one revolution, since the phase of the firing is uniform. The extreme of k revolutions lies
    nearer; the uniform density of the same mean square is sqrt(6 / ((k + 1)(k + 2))) wide.

    Args:
        revolutions: (R,) number merged in each ring.
    """
    return np.asarray(np.sqrt(6.0 / ((revolutions + 1) * (revolutions + 2))))
