"""Ring ends against the edges of the target: how far off they lie, and what moves them.

Candidates for the poses of several scans are worked out at once, so ring ends of scans lie side by side in arrays
(`RingEnds`). Scans have ring ends, rings without returns and noisy rings in different numbers: arrays are padded, by
what is like something that is there and makes no trouble; `there` and `silent` tell, and it counts for nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import CDLL
from dataclasses import dataclass, fields
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.beam import Beam, outermost_return, outermost_table
from optshape_graph.compiled import address, library, structure
from optshape_graph.edges import UP, EdgePoints, leftward, upward
from optshape_graph.pose.options import PoseOptions
from optshape_graph.se3 import apply
from optshape_graph.sensor import SensorModel, total_angle_sds
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class EdgeGeometry(Value):
    """Edge points against their edges at C poses: rows linear in the pose, and which way the unknowns move them.

    Attributes:
        labels: (C, M) edge of each edge point.
        direction: (C, M, 3) vector m of each row, target frame: m . (R p + t) - c is the distance from the edge, in
            the plane, of the point where the ray of p meets the plane.
        residual: (C, M) that distance, metres, negative inside, `shift` taken off.
        along: (C, M) how fast it grows along the ring, outwards, metres per radian.
        across: (C, M) how fast it grows with the offset across the edge, metres per beam width.
        shift: (C, M) how much further out the last return lies than a single ray would, metres.
        own: (C, M) variance across the edge, quantisation apart, m2: each edge point's own, and its ring's.
        of_ring: (C, M) the part of it that errors of elevations and azimuths make, m2.
        lifted: (C, M) how far each edge point moves across its edge with its ring's elevation, metres per radian.
        turned: (C, M) the same with its azimuth, metres per radian.
    """

    labels: Ints
    direction: Floats
    residual: Floats
    along: Floats
    across: Floats
    shift: Floats
    own: Floats
    of_ring: Floats
    lifted: Floats
    turned: Floats

    def select(self, index: Ints) -> EdgeGeometry:
        """Return those of some of the poses, at indices (K,)."""
        return EdgeGeometry(**{field.name: getattr(self, field.name)[index] for field in fields(self)})


FAR_BESIDE = 2.5
"""Target radii from the rings with returns beyond which a pose that meets any of them has no part."""


@dataclass(frozen=True, eq=False, repr=False)
class Padding(Value):
    """How rows of B scans, in different numbers, lie side by side in arrays of as many each.

    Attributes:
        there: (B, M) whether there is such a row.
        index: (B, M) which row it is of all scans', one after the other; a row that is like it where there is none.
    """

    there: Bools
    index: Ints

    @classmethod
    def of(cls, counts: Sequence[int]) -> Padding:
        """Lay out so many rows of each scan."""
        count = np.array(counts)[:, None]
        row = np.arange(count.max())
        return cls(row < count, np.maximum(np.cumsum(count)[:, None] - count + np.minimum(row, count - 1), 0))

    def padded(self, arrays: Sequence[Floats]) -> Floats:
        """Return arrays of the scans, each (its own number, ...), as one (B, M, ...)."""
        return np.concatenate(arrays)[self.index]


@dataclass(frozen=True, eq=False, repr=False)
class RingEnds(Value):
    """Ring ends of B scans, of targets with as many edges; B = 1 stands for any number of candidates.

    Attributes:
        there: (B, M) whether there is such a ring end.
        outer: (B, M) whether it says that the target ends before the next ring, and not where a ring ends.
        points: (B, M, 3) metres, LiDAR frame.
        sweep: (B, M, 3) motion of each as its ray turns outwards, metres per radian.
        leftward: (B, M, 3) motion of each with the azimuth, metres per radian.
        upward: (B, M, 3) motion of each with the elevation, metres per radian.
        ranges: (B, M) metres.
        beam: (B, M) width of the beam there, metres.
        lower: (B, M) azimuth beyond each from which on the boundary may lie, rad.
        width: (B, M) of the interval in which it lies, rad.
        step: (B, M) azimuth step, or the interval where that is wider, rad.
        scatter: (B, M) standard deviation of the interval's place, rad.
        ring_shift: (B, M) standard deviation of what moves both ends of a ring, rad.
        elevation_sd: (B, M) of each ring's elevation, what all rings share included, rad.
        azimuth_sd: (B, M) likewise of each ring's azimuth, rad.
        by_shift: (B, M, K) outward motion, rad, for a standard deviation of the blooming, and of noisy rings' shifts.
        plane: (B, 13, 13) quadratic form in [z; 1] of the returns' whitened distances from the plane.
        normals: (B, n, 2) of the target's edges.
        offsets: (B, n) of its edges, metres.
        vertices: (B, n, 3) of the target, metres.
        flatness: (B,) standard deviation of the target about its drawing, metres.
        beam_offset: (B,) how far in returns at edges lie, beam widths.
        offset_sd: (B,) standard deviation of that, beam widths.
        circumradius: (B,) of the target, metres.
        lost_ends: (B,) share of ring ends that are not within a step of the edge.
        lost_span: (B, 2) where the boundary may be beyond those, in units of azimuth steps.
        azimuth_step: (B,) rad.
        reference_azimuth: (B,) of each scan's returns, rad.
        beam_angle: (B,) mean of the beam's width over the range.
        lost_rings: (B,) probability that a ring returns nothing wherever the target is.
        silent: (B, O) whether there is such a ring above or below those with returns.
        elevations: (B, O) of these rings, rad.
    """

    there: Bools
    outer: Bools
    points: Floats
    sweep: Floats
    leftward: Floats
    upward: Floats
    ranges: Floats
    beam: Floats
    lower: Floats
    width: Floats
    step: Floats
    scatter: Floats
    ring_shift: Floats
    elevation_sd: Floats
    azimuth_sd: Floats
    by_shift: Floats
    plane: Floats
    normals: Floats
    offsets: Floats
    vertices: Floats
    flatness: Floats
    beam_offset: Floats
    offset_sd: Floats
    circumradius: Floats
    lost_ends: Floats
    lost_span: Floats
    azimuth_step: Floats
    reference_azimuth: Floats
    beam_angle: Floats
    lost_rings: Floats
    silent: Bools
    elevations: Floats

    @classmethod
    def of(cls, problems: Sequence[Problem]) -> RingEnds:
        """Return the ring ends of several scans, whose targets have as many edges, side by side."""
        edges, targets, beams, options, sensors, shifts = (
            [getattr(one, name) for one in problems]
            for name in ("edges", "target", "beam", "options", "sensor", "ring_shifts")
        )
        ends = Padding.of([len(one) for one in edges])
        points, lower, upper, scatter, shift, side = (
            ends.padded([getattr(one, name) for one in edges])
            for name in ("points", "lower", "upper", "scatter", "shift", "side")
        )
        by_elevation, by_azimuth = upward(points), leftward(points)
        outer = np.abs(side) == UP
        sweep = np.where(outer[..., None], by_elevation, by_azimuth) * np.sign(side)[..., None]
        angles = [total_angle_sds(sensor, one.ring) for sensor, one in zip(sensors, edges, strict=True)]
        by_shift = np.zeros((*ends.there.shape, 1 + max(one.shape[1] for one in shifts)))
        by_shift[..., 0] = ~outer * np.array([[beam.blooming] for beam in beams])
        for moved, one in zip(by_shift, shifts, strict=True):
            moved[: len(one), 1 : 1 + one.shape[1]] = one
        beside = [_beside(one) for one in problems]
        silent = Padding.of([len(one) for one in beside])
        ranges = np.sqrt(np.vecdot(points, points))
        width = np.stack([beam.width(at) for beam, at in zip(beams, ranges, strict=True)])
        step = np.array([one.azimuth_step for one in edges])
        return cls(
            there=ends.there,
            outer=outer,
            points=points,
            sweep=sweep,
            leftward=by_azimuth,
            upward=by_elevation,
            ranges=ranges,
            beam=width,
            lower=lower,
            width=upper - lower,
            step=np.maximum(upper - lower, step[:, None]),
            scatter=scatter,
            ring_shift=shift,
            elevation_sd=ends.padded([up for up, _ in angles]),
            azimuth_sd=ends.padded([left for _, left in angles]),
            by_shift=by_shift,
            plane=np.stack([one.plane for one in problems]),
            normals=np.stack([target.normals for target in targets]),
            offsets=np.stack([target.offsets for target in targets]),
            vertices=np.stack([target.vertices for target in targets]),
            flatness=np.array([one.flatness for one in options]),
            beam_offset=np.array([beam.offset for beam in beams]),
            offset_sd=np.array([beam.common for beam in beams]),
            circumradius=np.array([target.circumradius for target in targets]),
            lost_ends=np.array([one.lost_ends for one in options]),
            lost_span=np.array([one.lost_span for one in options]),
            azimuth_step=step,
            reference_azimuth=np.array([one.reference_azimuth for one in edges]),
            beam_angle=(ends.there * width / ranges).sum(axis=1) / ends.there.sum(axis=1),
            lost_rings=np.array([one.lost_rings for one in edges]),
            silent=silent.there,
            elevations=silent.padded(beside),
        )

    def take(self, scan: Ints) -> RingEnds:
        """Return the ring ends of each candidate (C,) by the scan that it is of; of one scan, themselves."""
        if len(self.there) == 1:
            return self
        return RingEnds(**{field.name: getattr(self, field.name)[scan] for field in fields(self)})

    @property
    def middle(self) -> Floats:
        """(B, M) azimuth beyond each point at which the boundary is expected, rad."""
        return np.asarray(self.lower + 0.5 * self.width)

    @property
    def lost_limits(self) -> tuple[Floats, Floats]:
        """Azimuths (B, M) beyond each point between which the boundary of one that is no last return lies, rad."""
        first, last = self.lost_span.T[..., None] * self.step
        return self.lower + first, self.lower + last

    @property
    def slowest(self) -> Floats:
        """(B, M) motion across an edge below which a ring counts as running along it, metres per radian."""
        return np.asarray(1e-3 * self.ranges)

    def outward(self, T: Floats) -> Floats:
        """(C, M, 3) outward motion of each in the target's plane at poses (C, 4, 4), metres per radian."""
        normal = T[:, 0, :3, None]
        return np.asarray(self.sweep - self.points * ((self.sweep @ normal) / (self.points @ normal)))

    def strains(self, labels: Ints, points: Floats, T: Floats) -> Floats:
        """(C, M, 2) how far two strains of the outline, of unit size at constant area, move points off edges.

        Args:
            labels: (C, M) edge of each point.
            points: (C, M, 3) metres, LiDAR frame.
            T: (C, 4, 4) T_target_lidar.
        """
        n, yz = self.normals[np.arange(len(self.normals))[:, None], labels], apply(T, points)[..., 1:]
        return np.stack([np.vecdot(n, yz * [1.0, -1.0]), np.vecdot(n, yz[..., ::-1])], axis=-1)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a pickle has: the arrays. Addresses are of one process."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def laid_out(self) -> tuple[Ints, list[NDArray[Any]]]:
        """(K,) counts, and addresses of arrays, numbers, as the compiled library has them; and these arrays."""
        arrays = [np.ascontiguousarray(getattr(self, name)) for name in _LAID_OUT]
        counts = (*self.there.shape, self.normals.shape[1], self.by_shift.shape[2], self.silent.shape[1])
        return structure(*counts, *arrays), arrays

    def _geometry(self, functions: CDLL, T: Floats, labels: Ints | None, scan: Ints | None) -> EdgeGeometry:
        """Look at the ring ends from poses by the compiled library, as `geometry` does."""
        shape = len(T), self.there.shape[1]
        if scan is None:
            scan = np.arange(len(T)) if len(self.there) > 1 else np.zeros(len(T), dtype=np.int64)
        assert len(scan) == len(T), "each pose is of a scan"
        assert scan.max(initial=0) < len(self.there), "of one of these scans"
        given = np.full(shape, -1)
        if labels is not None:
            given[:] = labels
        made = {name: np.empty((*shape, 3) if name == "direction" else shape) for name in _MADE}
        geometry = EdgeGeometry(given, **made)
        out = structure(given, *made.values())
        poses = np.ascontiguousarray(T)
        functions.edge_geometry(
            *map(address, (self.laid_out[0], _scatter())), len(T), *map(address, (scan, poses, out))
        )
        return geometry

    def geometry(self, T: Floats, labels: Ints | None = None, scan: Ints | None = None) -> EdgeGeometry:
        """Look at the ring ends from poses.

        Args:
            T: (C, 4, 4) T_target_lidar.
            labels: (C, M) edge of each ring end; -1, and None for all: the edge that it leaves by first.
            scan: (C,) of each pose; None: each is of its own, or all are of the one.
        """
        functions = library()
        if functions is not None:
            return self._geometry(functions, T, labels, scan)
        if scan is not None:
            return self.take(scan).geometry(T, labels)
        R, t = T[:, :3, :3], T[:, None, :3, 3]
        to_target = np.swapaxes(R, 1, 2)
        ray, turning = self.points @ to_target, self.sweep @ to_target
        y = ray + t
        slope = ray[..., 1:] / ray[..., :1]
        u = turning[..., 1:] - slope * turning[..., :1]  # in the plane
        if labels is None or (labels < 0).any():
            exits = self._exit_edges(y[..., 1:] - slope * y[..., :1], u)
            labels = exits if labels is None else np.where(labels < 0, exits, labels)
        labels = labels * self.there
        scan = np.arange(len(self.normals))[:, None]
        n = self.normals[scan, labels]
        mu = np.vecdot(n, slope)
        direction = np.concatenate([-mu[..., None], n], axis=-1)
        along = np.vecdot(n, u)
        across = self.beam * np.sqrt(1.0 + mu**2)
        shift, scatter = outermost_return(np.abs(along) * self.width / across)
        shift = (shift - self.beam_offset[:, None]) * across
        by_angle = direction @ R
        lifted, turned = np.vecdot(by_angle, self.upward), np.vecdot(by_angle, self.leftward)
        of_ring = self.elevation_sd**2 * lifted**2 + self.azimuth_sd**2 * turned**2
        own = self.flatness[:, None] ** 2 + (Beam.OWN * scatter * across) ** 2 + (self.scatter * along) ** 2
        return EdgeGeometry(
            labels=labels,
            direction=direction,
            residual=np.vecdot(direction, y) - self.offsets[scan, labels] - shift,
            along=along,
            across=across,
            shift=shift,
            own=own + of_ring,
            of_ring=of_ring,
            lifted=lifted,
            turned=turned,
        )

    def _exit_edges(self, yz: Floats, outward: Floats) -> Ints:
        """Edge by which rays in the plane (C, M, 2) first leave the polygon; the nearest line where none is ahead."""
        normals = np.swapaxes(self.normals, 1, 2)
        beyond = yz @ normals - self.offsets[:, None]
        speed = outward @ normals
        scale = 1e-3 * np.sqrt((outward * outward).sum(axis=-1, keepdims=True))
        ahead = np.where(speed > scale, -beyond / np.maximum(speed, scale), np.inf)
        leaves = np.isfinite(ahead.min(axis=-1))
        return np.asarray(np.where(leaves, ahead.argmin(axis=-1), np.abs(beyond).argmin(axis=-1)))


@cache
def _scatter() -> Ints:
    """Return the beam and the table of outermost returns, (K,) numbers, as the compiled library has them."""
    table = outermost_table()
    return structure(float(Beam.OWN), len(table[0]), *table)


_LAID_OUT = (
    "there", "points", "sweep", "leftward", "upward", "beam", "lower", "width", "step", "scatter", "elevation_sd",
    "azimuth_sd", "by_shift", "plane", "normals", "offsets", "vertices", "flatness", "beam_offset", "offset_sd",
    "lost_ends", "lost_span", "azimuth_step", "reference_azimuth", "beam_angle", "lost_rings", "silent", "elevations",
    "slowest",
)  # fmt: skip
"""Arrays of `RingEnds` in the order of the compiled library's structure."""

_MADE = tuple(field.name for field in fields(EdgeGeometry))[1:]
"""Arrays of `EdgeGeometry` after the labels."""


@dataclass(frozen=True, eq=False, repr=False)
class Problem(Value):
    """What is known of one target in one scan, whatever its pose.

    Attributes:
        edges: both ends of each ring.
        target: the template.
        plane: (13, 13) quadratic form in [z; 1] of the returns' whitened distances from the plane.
        beam: of the sensor, which scatters the ring ends about the edges.
        options: of them, how flat and true to its drawing a target is, and how many ring ends are lost.
        sensor: how far its rings look elsewhere than its file says; None: unknown.
    """

    edges: EdgePoints
    target: Target
    plane: Floats
    beam: Beam
    options: PoseOptions
    sensor: SensorModel | None = None

    @cached_property
    def ring_shifts(self) -> Floats:
        """(M, K) outward motion, rad, of each edge point for a standard deviation of each noisy ring's shift."""
        edges = self.edges
        noisy = np.unique(edges.ring[edges.shift > 0])
        return np.asarray((edges.ring[:, None] == noisy) * (edges.side * edges.shift)[:, None])

    @cached_property
    def ends(self) -> RingEnds:
        """The ring ends as arrays of one scan."""
        return RingEnds.of([self])

    def geometry(self, T: Floats, labels: Ints | None = None) -> EdgeGeometry:
        """Look at the ring ends from poses (C, 4, 4); without labels, a ring ends on the edge it leaves by first."""
        return self.ends.geometry(T, labels)


def _beside(problem: Problem) -> Floats:
    """(O,) elevations, rad, of a sensor's rings above and below those with returns that any pose in question may meet.

    None of an unknown sensor's.
    """
    edges, sensor = problem.edges, problem.sensor
    if sensor is None:
        return np.zeros(0)
    rings, table = edges.ring[np.abs(edges.side) < UP], sensor.elevations
    first, last = np.minimum(rings[[0, -1]], len(table) - 1)  # a sensor with fewer rings is another
    reach = FAR_BESIDE * problem.target.circumradius / np.sqrt(np.vecdot(edges.points, edges.points).min())
    low, high = np.searchsorted(table, [table[first] - reach, table[last] + reach])
    return np.concatenate([table[low : rings[0]], table[rings[-1] + 1 : high]])
