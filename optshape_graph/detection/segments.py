"""A scan ring by ring: segments between jumps of the range, runs of one surface, and the ends of runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.compiled import address, library
from optshape_graph.detection.options import DetectionOptions
from optshape_graph.edges import azimuth_spacing
from optshape_graph.errors import EstimationError
from optshape_graph.scan import Scan, rings_missing
from optshape_graph.sensor import SensorModel

_TURNS = (-2 * np.pi, 0.0, 2 * np.pi)  # an azimuth near the seam of the circle may be off by one of these, rad


Fired = Callable[[Ints], tuple[Scan, Floats]]
"""Given rows (K,) of a scan, returns them in a frame in which rings are where they were fired, and T_scan_frame."""


@dataclass(frozen=True)
class Resolution:
    """The resolution of a sensor, by its errors and its sampling.

    Attributes:
        step: rad between two firings of a beam.
        range_noise: standard deviation of one range, metres, rounding included.
        off_plane: standard deviation of a return's range about a plane, metres: noise and ring bias.
        beam: half the divergence, rad.
    """

    step: float
    range_noise: float
    off_plane: float
    beam: float


@dataclass(frozen=True, eq=False, repr=False)
class OrderedScan(Value):
    """A scan's returns sorted by ring and azimuth, and cut into segments.

    Attributes:
        scan: as it was given.
        fired: from which returns on a target its pose is estimated, where that is not the scan; see `Search`.
        index: (N,) row of the scan.
        points: (N, 3) metres, LiDAR frame.
        ring: (N,) ascending.
        azimuth: (N,) rad, in (-pi, pi], ascending in each ring.
        range: (N,) metres.
        first: (S,) first return of each segment.
        elevations: (R,) rad of each ring, ascending: the sensor's, or as seen.
        resolution: of the sensor that made it.
        options: the settings of detection, used in all steps.
    """

    scan: Scan
    fired: Fired | None
    index: Ints
    points: Floats
    ring: Ints
    azimuth: Floats
    range: Floats
    first: Ints
    elevations: Floats
    resolution: Resolution
    options: DetectionOptions

    def __len__(self) -> int:
        return len(self.index)

    def returns(self, rows: Ints) -> tuple[Scan, Floats]:
        """Return the returns of rows (K,) from which a pose is estimated, and their frame in the scan's, (4, 4)."""
        index = self.index[rows]
        return (self.scan.select(index), np.eye(4)) if self.fired is None else self.fired(index)

    @cached_property
    def last(self) -> Ints:
        """(S,) last return of each segment."""
        return np.append(self.first[1:], len(self)) - 1

    @cached_property
    def segment(self) -> Ints:
        """(N,) segment of each return."""
        return np.repeat(np.arange(len(self.first)), self.last - self.first + 1)

    @cached_property
    def long_segments(self) -> Ints:
        """Numbers (L,) of the segments whose returns are enough to have a direction."""
        return np.flatnonzero(self.last - self.first + 1 >= self.options.fewest_returns)

    @cached_property
    def ring_heights(self) -> Floats:
        """(R,) range of elevations that each ring covers, rad: half way to the next ring on either side."""
        return np.asarray(np.gradient(self.elevations))

    @cached_property
    def _positions(self) -> Floats:
        """(N,) ascending: by ring, then azimuth."""
        return _position(self.ring, self.azimuth)

    @cached_property
    def _rows(self) -> Ints:
        return np.arange(len(self))

    def band(self, plane_normal: Floats, centre: Floats) -> float:
        """Return the largest distance of a plane's own returns from it, metres.

        Ranges err along the ray, so a plane seen at an angle has a thinner band.

        Args:
            plane_normal: (3,) unit normal.
            centre: (3,) a point of the plane, metres.
        """
        cos_incidence = float(plane_normal @ centre / np.linalg.norm(centre))
        return self.options.band_sigmas * float(np.hypot(self.resolution.off_plane * cos_incidence, self.options.warp))

    def near(self, centre: Floats, reach: float) -> Ints:
        """Return the rows of the returns within `reach` of a point (3,), metres, ascending."""
        rows = self.toward(centre, reach)
        off = self.points.take(rows, axis=0) - centre
        return np.asarray(rows[np.einsum("ni,ni->n", off, off) < reach**2])

    def toward(self, centre: Floats, reach: float) -> Ints:
        """Return the rows of returns with the azimuths of points within `reach` of a point (3,), metres, ascending."""
        away = float(np.hypot(centre[0], centre[1]))
        rows = self._rows
        if reach >= away:
            return rows
        middle, half = float(np.arctan2(centre[1], centre[0])), float(np.arcsin(reach / away)) + 1e-9
        windows = [(max(middle - half + turn, -np.pi), min(middle + half + turn, np.pi)) for turn in _TURNS]
        ends = np.array([(first, last) for first, last in windows if first < last])
        places = _position(np.arange(len(self.elevations))[:, None, None], ends)
        first = np.searchsorted(self._positions, places[..., 0].ravel(), "left")
        last = np.searchsorted(self._positions, places[..., 1].ravel(), "right")
        return np.concatenate([rows[a:b] for a, b in zip(first.tolist(), last.tolist(), strict=True)])


def order_scan(scan: Scan, options: DetectionOptions, fired: Fired | None = None) -> OrderedScan:
    """Sort a scan's returns along its rings, and cut the rings where the range jumps.

    The azimuth step is the sensor's, or the median spacing of the returns if it states none. An unknown sensor has a
    centimetre of noise and a centimetre of ring bias.

    Raises:
        InputError: the cloud has no rings.
        EstimationError: fewer than two rings, or no azimuth step, neither stated nor seen.
    """
    if scan.ring is None:
        raise rings_missing(scan)
    if len(scan) == 0 or scan.ring.min() == scan.ring.max():
        raise EstimationError(f"{scan.name}: returns on {min(len(scan), 1)} rings; a target needs several")
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    order = _in_order(scan.ring, azimuth)
    points, ring, azimuth = scan.points.take(order, axis=0), scan.ring.take(order), azimuth.take(order)
    x, y, z = points.T
    ranges = np.sqrt(x * x + y * y + z * z)
    resolution = _resolution(scan, azimuth, ring)
    starts = _starts(ring, azimuth, ranges, resolution, options)
    elevations = scan.sensor.elevations if scan.sensor is not None else _elevations(points, ranges, ring)
    first = np.flatnonzero(starts)
    return OrderedScan(scan, fired, order, points, ring, azimuth, ranges, first, elevations, resolution, options)


def _in_order(ring: Ints, azimuth: Floats) -> Ints:
    """Return the rows (N,) by ring, and by azimuth in each.

    Once sorted by ring, whose numbers are small, the returns are mostly in order: both sorts are linear.
    """
    if (ring[1:] >= ring[:-1]).all():
        return np.argsort(_position(ring, azimuth), kind="stable")
    by_ring = np.argsort(ring.astype(np.uint16), kind="stable")
    return by_ring[np.argsort(_position(ring, azimuth)[by_ring], kind="stable")]


def _position(ring: Ints, azimuth: Floats) -> Floats:
    """Return numbers that grow along each ring and from ring to ring; a ring spans less than 8 rad."""
    return np.asarray(ring * 8.0 + azimuth)


def _elevations(points: Floats, ranges: Floats, ring: Ints) -> Floats:
    """Return the mean elevation (R,) of each ring with returns, rad; for rings between without any, interpolated."""
    present, inverse = np.unique(ring, return_inverse=True)
    mean = np.bincount(inverse, np.arcsin(points[:, 2] / ranges)) / np.bincount(inverse)
    return np.interp(np.arange(present[-1] + 1), present, mean)


def _resolution(scan: Scan, azimuth: Floats, ring: Ints) -> Resolution:
    sensor = scan.sensor if scan.sensor is not None else SensorModel(np.zeros(1), beam_divergence=3e-3)
    step = sensor.azimuth_step or azimuth_spacing(azimuth, ring)
    if step is None:
        raise EstimationError(f"{scan.name}: the sensor states no azimuth step, and no ring has two returns")
    noise = float(np.hypot(sensor.range_noise, sensor.range_resolution / np.sqrt(12)))
    return Resolution(step, noise, float(np.hypot(noise, sensor.ring_bias)), 0.5 * sensor.beam_divergence)


def _starts(ring: Ints, azimuth: Floats, ranges: Floats, resolution: Resolution, options: DetectionOptions) -> Bools:
    """Return (N,) whether a segment starts at each return.

    On either side of a boundary, the range is continued in a straight line from three returns. The two sides are one
    segment if either prediction meets the return across the boundary. That separates surfaces a few standard deviations
    of the noise apart at any incidence, which a bound on the jump itself cannot. With fewer than three returns on a
    side, the jump decides.
    """
    n, steepest = len(ring), float(np.tan(options.steepest))
    functions = library()
    if functions is not None:
        starts, arrays = np.empty(n, dtype=np.bool_), [np.ascontiguousarray(one) for one in (ring, azimuth, ranges)]
        limits = resolution.step, options.longest_gap, steepest, resolution.range_noise, options.jump_sigmas
        if functions.segment_starts(n, *map(address, arrays), *limits, address(starts)):
            raise MemoryError
        return starts
    gap, jump = np.diff(azimuth, prepend=azimuth[:1]), np.diff(ranges, prepend=ranges[:1])
    apart = (np.diff(ring, prepend=ring[:1] - 1) != 0) | (gap > options.longest_gap * resolution.step)
    run = np.cumsum(apart)
    off_line = np.full(n, np.inf)
    before = slice(3, n), slice(2, n - 1), slice(0, max(n - 3, 0)), 1.0
    after = slice(0, max(n - 2, 0)), slice(0, max(n - 2, 0)), slice(2, n), -1.0
    for at, near, far, way in (before, after):
        span = np.abs(azimuth[near] - azimuth[far])
        there = ~apart[at] & (run[far] == run[near]) & (span > 0.5 * resolution.step)
        span = np.where(there, span, 1.0)
        steep = steepest * ranges[at]
        slope = np.clip(way * (ranges[near] - ranges[far]) / span, -steep, steep)
        q = gap[at] / span
        sigma = resolution.range_noise * np.sqrt(1.0 + (1.0 + q) ** 2 + q**2)
        off = np.where(there, np.abs(jump[at] - slope * gap[at]) / sigma, np.inf)
        off_line[at] = np.minimum(off_line[at], off)
    short = np.isinf(off_line)
    off_line[short] = np.abs(jump[short]) / (np.sqrt(2.0) * resolution.range_noise)
    return np.asarray(apart | (off_line > options.jump_sigmas))


@dataclass(frozen=True, eq=False, repr=False)
class Runs(Value):
    """Returns of one surface, cut into runs along their rings.

    Attributes:
        rows: (N,) of the ordered scan, by ring and azimuth.
        azimuth: (N,) rad, relative to one of them, continuous across the seam.
        first: (K,) first return of each run, in `rows`.
        last: (K,) last return of each run.
        ring: (K,) of each run, ascending.
    """

    rows: Ints
    azimuth: Floats
    first: Ints
    last: Ints
    ring: Ints

    @cached_property
    def ends(self) -> Ints:
        """(2 M,) those of `rows` at which rings begin, ring by ring, then those at which they end."""
        first = np.flatnonzero(_beginning(self.ring[1:] != self.ring[:-1], len(self.ring)))
        last = np.append(first[1:], len(self.ring))[: len(first)] - 1
        return np.asarray(self.rows[np.concatenate([self.first[first], self.last[last]])])


def find_runs(scan: OrderedScan, rows: Ints) -> Runs:
    """Cut returns, `rows` (N,) of one side of the sensor, into runs along their rings."""
    azimuth, ring = scan.azimuth[rows], scan.ring[rows]
    azimuth = (azimuth - azimuth[:1] + np.pi) % (2 * np.pi) - np.pi
    turned, onward = azimuth[1:] - azimuth[:-1], ring[1:] - ring[:-1]
    if ((onward < 0) | ((onward == 0) & (turned < 0))).any():  # mostly they are in order already
        order = np.lexsort((azimuth, ring))
        rows, azimuth, ring = rows[order], azimuth[order], ring[order]
        turned, onward = azimuth[1:] - azimuth[:-1], ring[1:] - ring[:-1]
    longest_gap = scan.options.longest_gap * scan.resolution.step
    first = np.flatnonzero(_beginning((onward != 0) | (turned > longest_gap), len(rows)))
    last = np.append(first[1:], len(rows)) - 1 if len(rows) else first
    return Runs(rows, azimuth, first, last, ring[first])


def _beginning(changes: Bools, n: int) -> Bools:
    """Return (n,) whether a run begins at each of n rows, by whether anything changes at all but the first (n - 1,)."""
    begins = np.ones(n, dtype=bool)
    begins[1:] = changes
    return begins


@dataclass(frozen=True, eq=False, repr=False)
class Borders(Value):
    """The kinds of ring ends on a surface. An end that is neither open nor hidden is one where the surface bends away.

    Attributes:
        open: (2 M,) whether the range jumps back beyond the end, or nothing returns, so that the surface ends there.
        hidden: (2 M,) whether an object in front follows, behind which the surface may go on.
    """

    open: Bools
    hidden: Bools


def find_borders(scan: OrderedScan, ends: Ints) -> Borders:
    """Return the kinds of a surface's ring ends, by the returns beyond them.

    A few returns beyond an end, and segments as short, are skipped, since part of their light came from behind.

    Args:
        scan: the ordered scan.
        ends: (2 M,) rows of it, of the surface; see `Runs.ends`.
    """
    fewest, segment, long = scan.options.fewest_returns, scan.segment, scan.long_segments
    side = np.repeat([-1, 1], len(ends) // 2)
    further = (ends + fewest * side).clip(0, len(scan) - 1)
    goes_on = (segment[further] == segment[ends]) & (further != ends)
    after, before = np.searchsorted(long, segment[ends], "right"), np.searchsorted(long, segment[ends]) - 1
    place = np.where(side > 0, after, before)
    there = (place >= 0) & (place < len(long))
    neighbour = long[place.clip(0, len(long) - 1)]
    beyond = np.where(side > 0, scan.first[neighbour], scan.last[neighbour])
    there &= scan.ring[beyond] == scan.ring[ends]
    away = np.abs(scan.azimuth[beyond] - scan.azimuth[ends])
    there &= away <= 2 * scan.options.longest_gap * scan.resolution.step
    hidden = there & ~goes_on & (scan.range[beyond] < scan.range[ends])
    return Borders(open=~goes_on & ~hidden, hidden=hidden)
