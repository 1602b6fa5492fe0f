"""Ring ends against the edges of the target: how far off they lie, what moves them, and how well they fit a pose.

Candidates for the poses of several scans are worked out at once, so ring ends of scans lie side by side in arrays
(`RingEnds`). Scans have ring ends, rings without returns and noisy rings in different numbers: arrays are padded, by
what is like something that is there and makes no trouble; `there` and `silent` tell, and it counts for nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.beam import Beam, outermost_return
from optshape_graph.edges import UP, EdgePoints, leftward, upward
from optshape_graph.factors._rows import triangular
from optshape_graph.gaussian import chi_square_tail, f_tail
from optshape_graph.pose.options import PoseOptions
from optshape_graph.se3 import apply
from optshape_graph.sensor import SensorModel, total_angle_sds
from optshape_graph.target import Target

SEEN = 0.02
"""Probability of the F test below which a shape, of the surface or of the outline, counts as seen, and its size widens
the pose: one clean scan in fifty pays for one that isn't there, and little, for what chance makes is small."""

CLIP = 3.0
"""Standard deviations that a ring end counts as at most: strays don't decide a mean square."""

EXPECTED = 1.15
"""Mean square of ring ends up to which nothing is widened: a tenth of clean scans exceed it."""

_HUBER = 1.5
_REWEIGHTINGS = 5


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


@dataclass(frozen=True, eq=False, repr=False)
class RingEnds(Value):
    """Ring ends of B scans, of targets with as many edges; B = 1 stands for any number of candidates.

    Attributes:
        there: (B, M) whether there is such a ring end.
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
    lost_ends: Floats
    lost_span: Floats
    azimuth_step: Floats
    reference_azimuth: Floats
    beam_angle: Floats
    lost_rings: Floats
    silent: Bools
    elevations: Floats

    @classmethod
    def of(
        cls,
        edges: EdgePoints,
        target: Target,
        plane: Floats,
        beam: Beam,
        options: PoseOptions,
        sensor: SensorModel | None,
        ring_shifts: Floats,
    ) -> RingEnds:
        """Return the ring ends of one scan; see `Problem`."""
        ranges = np.linalg.norm(edges.points, axis=1)
        blooming = np.where(np.abs(edges.side) < UP, beam.blooming, 0.0)
        up, left = total_angle_sds(sensor, edges.ring)
        rings = edges.ring[np.abs(edges.side) < UP]
        outer = np.zeros(0) if sensor is None else np.delete(sensor.elevations, slice(rings[0], rings[-1] + 1))
        one = {
            "there": np.ones(len(edges), dtype=bool), "points": edges.points, "sweep": edges.sweep,
            "leftward": leftward(edges.points), "upward": upward(edges.points), "ranges": ranges,
            "beam": beam.width(ranges), "lower": edges.lower, "width": edges.width,
            "step": np.maximum(edges.width, edges.azimuth_step), "scatter": edges.scatter, "elevation_sd": up,
            "azimuth_sd": left, "by_shift": np.column_stack([blooming, ring_shifts]), "plane": plane,
            "normals": target.normals, "offsets": target.offsets, "vertices": target.vertices,
            "flatness": options.flatness, "beam_offset": beam.offset, "offset_sd": beam.common,
            "lost_ends": options.lost_ends, "lost_span": options.lost_span, "azimuth_step": edges.azimuth_step,
            "reference_azimuth": edges.reference_azimuth, "beam_angle": np.mean(beam.width(ranges) / ranges),
            "lost_rings": edges.lost_rings, "silent": np.ones(len(outer), dtype=bool), "elevations": outer,
        }  # fmt: skip
        return cls(**{name: np.asarray(values)[None] for name, values in one.items()})

    @classmethod
    def side_by_side(cls, scans: Sequence[RingEnds]) -> RingEnds:
        """Return the ring ends of several scans, whose targets have as many edges."""
        if len(scans) == 1:
            return scans[0]
        made = {}
        for field in fields(cls):
            arrays = [getattr(scan, field.name) for scan in scans]
            shape = np.max([array.shape for array in arrays], axis=0)
            made[field.name] = np.concatenate([_padded(array, shape, field.name) for array in arrays])
        return cls(**made)

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

    def geometry(self, T: Floats, labels: Ints | None = None) -> EdgeGeometry:
        """Look at the ring ends from poses.

        Args:
            T: (C, 4, 4) T_target_lidar, each of its scan.
            labels: (C, M) edge of each ring end; -1, and None for all: the edge that it leaves by first.
        """
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
        mu = (n * slope).sum(axis=-1)
        direction = np.concatenate([-mu[..., None], n], axis=-1)
        along = (n * u).sum(axis=-1)
        across = self.beam * np.sqrt(1.0 + mu**2)
        shift, scatter = outermost_return(np.abs(along) * self.width / across)
        shift = (shift - self.beam_offset[:, None]) * across
        by_angle = direction @ R
        lifted, turned = (by_angle * self.upward).sum(axis=-1), (by_angle * self.leftward).sum(axis=-1)
        of_ring = self.elevation_sd**2 * lifted**2 + self.azimuth_sd**2 * turned**2
        own = self.flatness[:, None] ** 2 + (Beam.OWN * scatter * across) ** 2 + (self.scatter * along) ** 2
        return EdgeGeometry(
            labels=labels,
            direction=direction,
            residual=(direction * y).sum(axis=-1) - self.offsets[scan, labels] - shift,
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
    def blooming(self) -> Floats:
        """(M, 1) outward motion, rad, of each ring end for a standard deviation of the blooming that all share."""
        return np.where(np.abs(self.edges.side) < UP, self.beam.blooming, 0.0)[:, None]

    @cached_property
    def ends(self) -> RingEnds:
        """The ring ends as arrays of one scan."""
        return RingEnds.of(self.edges, self.target, self.plane, self.beam, self.options, self.sensor, self.ring_shifts)

    def geometry(self, T: Floats, labels: Ints | None = None) -> EdgeGeometry:
        """Look at the ring ends from poses (C, 4, 4); without labels, a ring ends on the edge it leaves by first."""
        return self.ends.geometry(T, labels)

    def fit(self, T_target_lidar: Floats, labels: Ints) -> EndsFit:
        """Fit the pose in the plane, the offset and the blooming to the ring ends, and two strains on top.

        Each end stands for the middle of its interval, with the interval's variance beside its own: no label, no rival
        and no robust weight of the estimate itself hides a residual.

        Args:
            T_target_lidar: (4, 4) near the best.
            labels: (M,) edge of each ring end.
        """
        edges, target = self.edges, self.target
        g = self.geometry(T_target_lidar[None], labels[None])
        along, across = g.along[0], g.across[0]
        sd = np.sqrt(g.own[0] + along**2 * (edges.width**2 / 12 + edges.shift**2))
        boundary = edges.points + edges.middle[:, None] * edges.outward(T_target_lidar[0, :3])
        y, z = (boundary @ T_target_lidar[1:3, :3].T + T_target_lidar[1:3, 3]).T
        ny, nz = target.normals[labels].T
        pose = [ny, nz, (nz * y - ny * z) / target.circumradius]
        strains = self.strains(labels, boundary, T_target_lidar)
        residual = g.residual[0] + along * edges.middle
        common = [across * self.beam.common, -along * self.blooming[:, 0]]
        rows = np.column_stack([*pose, *common, strains, residual]) / sd[:, None]
        prior = np.diag([1e-6, 1e-6, 1e-6, 1.0, 1.0])
        weight = np.ones(len(rows))
        for _ in range(_REWEIGHTINGS):
            A = weight[:, None] * rows[:, :5]
            x = -np.linalg.solve(A.T @ rows[:, :5] + prior, A.T @ rows[:, 7])
            residual = rows[:, :5] @ x + rows[:, 7]
            weight = 1.0 / np.maximum(np.abs(residual) / _HUBER, 1.0)
        strain, probability = _strain(np.sqrt(weight)[:, None] * rows)
        return EndsFit(residual, sd, float(x[3]), float(x[4]), max(len(residual) - 3, 0), strain, probability)

    def strains(self, labels: Ints, points: Floats, T_target_lidar: Floats) -> Floats:
        """(..., M, 2) how far two strains of the outline, of unit size at constant area, move points off edges.

        Args:
            labels: (..., M) edge of each point.
            points: (..., M, 3) metres, LiDAR frame.
            T_target_lidar: (..., 4, 4).
        """
        n, yz = self.target.normals[labels], apply(T_target_lidar, points)[..., 1:]
        return np.stack([(n * yz * [1.0, -1.0]).sum(axis=-1), (n * yz[..., ::-1]).sum(axis=-1)], axis=-1)


@dataclass(frozen=True, eq=False, repr=False)
class EndsFit(Value):
    """Ring ends against the edges, after pose in the plane, common offset and blooming were fitted, robustly.

    Attributes:
        z: (M,) residuals in standard deviations, positive outside.
        sd: (M,) those standard deviations, across the edges, metres.
        offset: common offset across the edges in standard deviations of its prior, positive: returns lie further in.
        blooming: how much further the rings reach, in standard deviations of its prior.
        freedom: degrees of freedom: of the pose in the plane are three, offset and blooming have priors.
        strain: stretch of the outline at constant area that the ends ask for beside the pose, relative.
        strain_probability: of so much by chance.
    """

    z: Floats
    sd: Floats
    offset: float
    blooming: float
    freedom: int
    strain: float
    strain_probability: float

    @property
    def chi_square(self) -> float:
        """Sum of the squares of all residuals, of the offset and of the blooming."""
        return float(self.z @ self.z) + self.offset**2 + self.blooming**2

    @property
    def clipped_mean_square(self) -> float:
        """Mean square residual, none counting beyond CLIP: about 1 where all is well."""
        return float(np.minimum(self.z**2, CLIP**2).sum()) / max(len(self.z), 1)

    @property
    def probability(self) -> float:
        """Of so large a clipped sum of squares by chance."""
        return chi_square_tail(self.clipped_mean_square * len(self.z), self.freedom)

    @property
    def factor(self) -> float:
        """By how much standard deviations of ring ends are to be widened: 1 where they scatter as they should."""
        return float(np.sqrt(max(1.0, self.clipped_mean_square / EXPECTED)))

    @property
    def seen_strain(self) -> float:
        """The strain where it is seen, 0 elsewhere."""
        return self.strain if self.strain_probability < SEEN else 0.0

    @property
    def share_beyond(self) -> float:
        """Share of ring ends beyond CLIP standard deviations."""
        return float(np.mean(np.abs(self.z) > CLIP)) if len(self.z) else 0.0

    @property
    def longest_run(self) -> float:
        """Largest |sum z| / sqrt(k) over k neighbouring ends of one side and sign, times their share of that side."""
        worst = 0.0
        for of in (self.z[0::2], self.z[1::2]):
            starts = np.flatnonzero(np.diff(np.sign(of), prepend=0.0))
            for start, stop in zip(starts, np.append(starts[1:], len(of)), strict=True):
                k = int(stop - start)
                worst = max(worst, abs(float(of[start:stop].sum())) / np.sqrt(k) * k / len(of))
        return worst


def _strain(rows: Floats) -> tuple[float, float]:
    """Size of the two strains in whitened rows (M, 8), and the F test of whether they are there."""
    R = triangular(np.vstack([rows, np.eye(8)[3:5]]))  # the priors of offset and blooming
    freedom = len(rows) + 2 - 7
    if freedom < 3 or np.abs(np.diag(R)[:7]).min() < 1e-6 * np.abs(np.diag(R)[:7]).max():
        return 0.0, 1.0
    x = np.linalg.solve(R[5:7, 5:7], R[5:7, 7])
    F = float((R[5:7, 7] ** 2).sum()) / 2 / max(float(R[7, 7] ** 2) / freedom, 1.0)
    return float(np.hypot(*x)), f_tail(F, 2, freedom)


def _padded(array: Floats, shape: Ints, name: str) -> Floats:
    """Return an array (1, ...) made as large as a shape: by its first entries, by zeros where it has to be nothing."""
    missing = [(0, int(size) - have) for size, have in zip(shape[1:], array.shape[1:], strict=True)]
    if not any(count for _, count in missing):
        return array
    nothing = name in ("there", "silent") or not array.size
    if name == "by_shift":  # a ring's shift that isn't there moves nothing
        array, missing[1] = np.pad(array, [(0, 0), (0, 0), missing[1]]), (0, 0)
    return np.pad(array, [(0, 0), *missing], mode="constant" if nothing else "edge")
