"""Ring ends against the edges of the target: how far off they lie, what moves them, and how well they fit a pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.beam import Beam, outermost_return
from optshape_graph.edges import UP, EdgePoints, leftward, upward
from optshape_graph.factors._rows import triangular
from optshape_graph.gaussian import chi_square_tail, f_tail
from optshape_graph.pose.options import PoseOptions
from optshape_graph.sensor import SensorModel, angle_sds
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
    def intervals(self) -> Floats:
        """(2, 2, M) ends of where the boundary may be beyond each edge point, rad.

        First for a ring's last return; then for an end that is not its last return.
        """
        edges, (first, last) = self.edges, self.options.lost_span
        step = np.maximum(edges.width, edges.azimuth_step)
        return np.array([[edges.lower, edges.upper], [edges.lower + first * step, edges.lower + last * step]])

    def geometry(self, T: Floats, labels: Ints | None = None) -> EdgeGeometry:
        """Look at the edge points from poses (C, 4, 4); without labels, a ring ends on the edge it leaves by first."""
        edges, target = self.edges, self.target
        R, t = T[:, :3, :3], T[:, :3, 3]
        normal = R[:, 0]
        p = edges.points
        turning = edges.sweep
        distance = normal @ p.T
        outward = turning - p * ((normal @ turning.T) / distance)[..., None]
        u = (outward @ np.swapaxes(R, 1, 2))[..., 1:]
        y = p @ np.swapaxes(R, 1, 2) + t[:, None]
        ray = (p / np.linalg.norm(p, axis=1, keepdims=True)) @ np.swapaxes(R, 1, 2)
        slope = ray[..., 1:] / ray[..., :1]
        if labels is None:
            labels = _exit_edges(y[..., 1:] - slope * y[..., :1], u, target)
        n = target.normals[labels]
        mu = (n * slope).sum(axis=-1)
        direction = np.concatenate([-mu[..., None], n], axis=-1)
        along = (n * u).sum(axis=-1)
        across = self.beam.width(np.linalg.norm(p, axis=1)) * np.sqrt(1.0 + mu**2)
        shift, scatter = outermost_return(np.abs(along) * edges.width / across)
        shift = (shift - self.beam.offset) * across
        up, left = angle_sds(self.sensor, edges.ring)
        by_angle = direction @ R
        lifted, turned = (by_angle * upward(p)).sum(axis=-1), (by_angle * leftward(p)).sum(axis=-1)
        of_ring = (up * lifted) ** 2 + (left * turned) ** 2
        if self.sensor is not None:
            common = self.sensor.common_elevation_sd, self.sensor.common_azimuth_sd
            of_ring = of_ring + (common[0] * lifted) ** 2 + (common[1] * turned) ** 2
        own = self.options.flatness**2 + (self.beam.OWN * scatter * across) ** 2 + (edges.scatter * along) ** 2
        return EdgeGeometry(
            labels=labels,
            direction=direction,
            residual=(direction * y).sum(axis=-1) - target.offsets[labels] - shift,
            along=along,
            across=across,
            shift=shift,
            own=own + of_ring,
            of_ring=of_ring,
            lifted=lifted,
            turned=turned,
        )

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
        return EndsFit(residual, float(x[3]), float(x[4]), max(len(residual) - 3, 0), strain, probability)

    def strains(self, labels: Ints, points: Floats, T_target_lidar: Floats) -> Floats:
        """(M, 2) how far two strains of the outline, of unit size at constant area, move points (M, 3) off edges."""
        ny, nz = self.target.normals[labels].T
        y, z = (points @ T_target_lidar[1:3, :3].T + T_target_lidar[1:3, 3]).T
        return np.column_stack([ny * y - nz * z, ny * z + nz * y])


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


@dataclass(frozen=True, eq=False, repr=False)
class EndsFit(Value):
    """Ring ends against the edges, after pose in the plane, common offset and blooming were fitted, robustly.

    Attributes:
        z: (M,) residuals in standard deviations, positive outside.
        offset: common offset across the edges in standard deviations of its prior, positive: returns lie further in.
        blooming: how much further the rings reach, in standard deviations of its prior.
        freedom: degrees of freedom: of the pose in the plane are three, offset and blooming have priors.
        strain: stretch of the outline at constant area that the ends ask for beside the pose, relative.
        strain_probability: of so much by chance.
    """

    z: Floats
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


def _exit_edges(yz: Floats, outward: Floats, target: Target) -> Ints:
    """Edge by which rays in the plane (C, M, 2) first leave the polygon; the nearest line where none is ahead."""
    beyond = yz @ target.normals.T - target.offsets
    speed = outward @ target.normals.T
    scale = 1e-3 * np.linalg.norm(outward, axis=-1, keepdims=True)
    ahead = np.where(speed > scale, -beyond / np.maximum(speed, scale), np.inf)
    leaves = np.isfinite(ahead.min(axis=-1))
    return np.asarray(np.where(leaves, ahead.argmin(axis=-1), np.abs(beyond).argmin(axis=-1)))


def _strain(rows: Floats) -> tuple[float, float]:
    """Size of the two strains in whitened rows (M, 8), and the F test of whether they are there."""
    R = triangular(np.vstack([rows, np.eye(8)[3:5]]))  # the priors of offset and blooming
    freedom = len(rows) + 2 - 7
    if freedom < 3 or np.abs(np.diag(R)[:7]).min() < 1e-6 * np.abs(np.diag(R)[:7]).max():
        return 0.0, 1.0
    x = np.linalg.solve(R[5:7, 5:7], R[5:7, 7])
    F = float((R[5:7, 7] ** 2).sum()) / 2 / max(float(R[7, 7] ** 2) / freedom, 1.0)
    return float(np.hypot(*x)), f_tail(F, 2, freedom)
