"""What ring ends, returns outside and missing returns say of the outline, once the pose is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.edges import relative_azimuth
from optshape_graph.factors._rows import triangular
from optshape_graph.gaussian import chi_square_tail, f_tail
from optshape_graph.pose.propagation import Problem, edge_geometry
from optshape_graph.pose.rays import chords, sight_planes
from optshape_graph.pose.surface import SEEN
from optshape_graph.scan import Scan
from optshape_graph.target import Target

CLIP = 3.0
"""Standard deviations that a ring end counts as at most: strays don't decide a mean square."""

EXPECTED = 1.15
"""Mean square of ring ends up to which nothing is widened: a tenth of clean scans exceed it."""

_HUBER = 1.5
_REWEIGHTINGS = 5


@dataclass(frozen=True, eq=False, repr=False)
class Ends(Value):
    """Ring ends against the edges, after the pose in the plane and their common offset were fitted to them robustly.

    Attributes:
        z: (M,) residuals in standard deviations, positive outside.
        offset: common offset across the edges in standard deviations of its prior, positive: returns lie further in.
        freedom: degrees of freedom: of the pose in the plane are three, the offset has its prior.
        strain: stretch of the outline at constant area that the ends ask for beside the pose, relative.
        strain_probability: of so much by chance.
    """

    z: Floats
    offset: float
    freedom: int
    strain: float
    strain_probability: float

    @property
    def chi_square(self) -> float:
        """Sum of the squares of all residuals and of the offset."""
        return float(self.z @ self.z) + self.offset**2

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


def fit_ends(problem: Problem, T_target_lidar: Floats, labels: Ints) -> Ends:
    """Fit the pose in the plane and the offset to the ring ends, and two strains on top.

    Each end stands for the middle of its interval, with the interval's variance beside its own: no label, no rival and
    no robust weight of the estimate itself hides a residual.

    Args:
        problem: ring ends, target and noise.
        T_target_lidar: (4, 4) near the best.
        labels: (M,) edge of each ring end.
    """
    edges, target = problem.edges, problem.target
    g = edge_geometry(problem, T_target_lidar[None], labels[None])
    along, across = g.along[0], g.across[0]
    sd = np.sqrt(g.own[0] + along**2 * (edges.width**2 / 12 + edges.shift**2))
    boundary = edges.points + edges.middle[:, None] * edges.outward(T_target_lidar[0, :3])
    y, z = (boundary @ T_target_lidar[1:3, :3].T + T_target_lidar[1:3, 3]).T
    ny, nz = target.normals[labels].T
    pose = [ny, nz, (nz * y - ny * z) / target.circumradius]
    strains = strain_columns(target, labels, boundary, T_target_lidar)
    residual = g.residual[0] + along * edges.middle
    rows = np.column_stack([*pose, across * problem.noise.common, strains, residual]) / sd[:, None]
    prior = np.diag([1e-6, 1e-6, 1e-6, 1.0])
    weight = np.ones(len(rows))
    for _ in range(_REWEIGHTINGS):
        A = weight[:, None] * rows[:, :4]
        x = -np.linalg.solve(A.T @ rows[:, :4] + prior, A.T @ rows[:, 6])
        residual = rows[:, :4] @ x + rows[:, 6]
        weight = 1.0 / np.maximum(np.abs(residual) / _HUBER, 1.0)
    strain, probability = _strain(np.sqrt(weight)[:, None] * rows)
    return Ends(residual, float(x[3]), max(len(residual) - 3, 0), strain, probability)


def strain_columns(target: Target, labels: Ints, points: Floats, T_target_lidar: Floats) -> Floats:
    """(M, 2) how far two strains of the outline, of unit size and of constant area, move points (M, 3) across edges."""
    ny, nz = target.normals[labels].T
    y, z = (points @ T_target_lidar[1:3, :3].T + T_target_lidar[1:3, 3]).T
    return np.column_stack([ny * y - nz * z, ny * z + nz * y])


def _strain(rows: Floats) -> tuple[float, float]:
    """Size of the two strains in whitened rows (M, 7), and the F test of whether they are there."""
    R = triangular(np.vstack([rows, np.eye(7)[3:4]]))  # the offset's prior
    freedom = len(rows) + 1 - 6
    if freedom < 3 or np.abs(np.diag(R)[:6]).min() < 1e-6 * np.abs(np.diag(R)[:6]).max():
        return 0.0, 1.0
    x = np.linalg.solve(R[4:6, 4:6], R[4:6, 6])
    F = float((R[4:6, 6] ** 2).sum()) / 2 / max(float(R[6, 6] ** 2) / freedom, 1.0)
    return float(np.hypot(*x)), f_tail(F, 2, freedom)


@dataclass(frozen=True, eq=False, repr=False)
class Coverage(Value):
    """Where the returns are and are not, against the outline.

    Attributes:
        outside: (N,) how far each return lies outside the outline, in beam widths; negative inside.
        missing_left: firings beyond the left ends of rings that should have returned and didn't.
        missing_right: the same beyond right ends.
        missing_inside: between returns.
        missing_rings: rings above and below those that returned whose chord holds two firings and more.
        expected: number of returns that the outline should have.
        cut: most neighbouring ends of one side at one azimuth where the outline isn't.
    """

    outside: Floats
    missing_left: float
    missing_right: float
    missing_inside: float
    missing_rings: int
    expected: float
    cut: int


def coverage(scan: Scan, problem: Problem, T_target_lidar: Floats, angular_noise: float) -> Coverage:
    """Count returns outside the outline, and firings that are missing inside.

    Args:
        scan: the returns.
        problem: both ends of each ring, the template, and the beam.
        T_target_lidar: (4, 4).
        angular_noise: standard deviation of one azimuth, rad.
    """
    assert scan.ring is not None
    edges, target = problem.edges, problem.target
    ranges = np.linalg.norm(scan.points, axis=1)
    step, outside = edges.azimuth_step, outside_beams(scan, problem, T_target_lidar, angular_noise)
    first = edges.points[::2]
    elevation = np.arctan2(first[:, 2], np.hypot(first[:, 0], first[:, 1]))
    sides = sight_planes((target.vertices - T_target_lidar[:3, 3])[None] @ T_target_lidar[:3, :3])
    right, left = (ends[0] for ends in chords(sides, elevation, edges.reference_azimuth))
    slack = step + float(np.median(_reach(problem, ranges, angular_noise) / ranges))
    beyond_left, beyond_right = left - edges.azimuth[::2], edges.azimuth[1::2] - right
    # A ring that looks elsewhere than the table says ends elsewhere, far from there where it runs along the edge.
    at = edge_geometry(problem, T_target_lidar[None])
    elsewhere = 2 * np.hypot(at.lifted[0], at.turned[0]) / np.maximum(np.abs(at.along[0]), 1e-6)
    slack_left, slack_right = slack + elsewhere[::2], slack + elsewhere[1::2]
    azimuth, _ = relative_azimuth(scan.points)
    order = np.lexsort((azimuth, scan.ring))
    gaps = np.diff(azimuth[order])[np.diff(scan.ring[order]) == 0] / step
    missing_rings = 0
    if scan.sensor is not None:
        beside = np.r_[: edges.ring[0], edges.ring[-1] + 1 : scan.sensor.n_rings]
        low, high = chords(sides, scan.sensor.elevations[beside], edges.reference_azimuth)
        missing_rings = int(np.count_nonzero(high - low > step + slack))
    return Coverage(
        outside=outside,
        missing_left=float(np.maximum(beyond_left - slack_left, 0.0).sum()) / step,
        missing_right=float(np.maximum(beyond_right - slack_right, 0.0).sum()) / step,
        missing_inside=float(np.maximum(np.rint(gaps) - 1, 0).sum()),
        missing_rings=missing_rings,
        expected=float((np.maximum(left - right, 0.0) * edges.revolutions[::2]).sum()) / step,
        cut=max(
            _at_one_azimuth(edges.azimuth[::2], beyond_left, step, slack_left),
            _at_one_azimuth(edges.azimuth[1::2], beyond_right, step, slack_right),
        ),
    )


def outside_beams(scan: Scan, problem: Problem, T_target_lidar: Floats, angular_noise: float) -> Floats:
    """(N,) how far returns lie outside the outline, in beam widths; negative inside. Arguments as of `coverage`."""
    beyond = problem.target.outside_distance(in_plane(scan.points, T_target_lidar))
    return np.asarray(beyond / _reach(problem, np.linalg.norm(scan.points, axis=1), angular_noise))


def _reach(problem: Problem, ranges: Floats, angular_noise: float) -> Floats:
    """(N,) how far outside returns at ranges (N,) may lie, metres: a beam, and three standard deviations."""
    return np.asarray(np.maximum(problem.noise.width(ranges), NARROWEST) + 3 * angular_noise * ranges)


NARROWEST = 5e-3
"""Width that a beam counts as at least where returns outside are measured by it, metres: a board isn't cut truer."""


def _at_one_azimuth(azimuth: Floats, beyond: Floats, step: float, slack: Floats) -> int:
    """Most ends within 1.5 steps of azimuth, the outline being a step and the beam away from each."""
    odd = np.sort(azimuth[np.abs(beyond) > step + slack])
    return int((np.searchsorted(odd, odd + 1.5 * step, side="right") - np.arange(len(odd))).max(initial=0))


def in_plane(points: Floats, T_target_lidar: Floats) -> Floats:
    """(N, 2) y and z of where the rays of returns (N, 3) meet the target's plane, metres."""
    R, t = T_target_lidar[:3, :3], T_target_lidar[:3, 3]
    met = points * (-t[0] / (points @ R[0]))[:, None]
    return np.asarray(met @ R[1:].T + t[1:])


def tilt_of_rings(scan: Scan) -> tuple[float, float]:
    """How elevations vary with azimuth within rings: rms, rad, of a line through each, and its probability by chance.

    A ring is a cone about the sensor's own axis. In the frame of a vehicle, or after points were corrected for motion,
    it is none.
    """
    assert scan.ring is not None
    elevation = np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1]))
    azimuth, _ = relative_azimuth(scan.points)
    _, column, counts = np.unique(scan.ring, return_inverse=True, return_counts=True)
    off = elevation - (np.bincount(column, elevation) / counts)[column]
    a = azimuth - (np.bincount(column, azimuth) / counts)[column]
    square = np.bincount(column, a * a)
    fitted = (np.bincount(column, a * off) / np.maximum(square, 1e-12))[column] * a
    k = int((square > 1e-12).sum())
    freedom = len(scan) - len(counts) - k
    left = float(((off - fitted) ** 2).sum()) / max(freedom, 1)
    F = float((fitted**2).sum()) / max(k, 1) / max(left, 1e-16)
    return float(np.sqrt(np.mean(fitted**2))), f_tail(F, max(k, 1), freedom)
