"""How ring ends lie about the edges of the target: a robust fit beside the estimate, and what it says of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.factors._rows import triangular
from optshape_graph.gaussian import chi_square_tail, f_tail
from optshape_graph.pose.ends.ring_ends import RingEnds
from optshape_graph.se3 import apply

SEEN = 0.02
"""Probability of the F test below which a shape, of the surface or of the outline, counts as seen, and its size widens
the pose: one clean scan in fifty pays for one that isn't there, and little, for what chance makes is small."""

CLIP = 3.0
"""Standard deviations that a ring end counts as at most: strays don't decide a mean square."""

EXPECTED = 1.15
"""Mean square of ring ends up to which nothing is widened: a tenth of clean scans exceed it."""

_HUBER = 1.5
_REWEIGHTINGS = 5
_PRIORS = np.eye(8)[3:5]  # of offset and blooming


def fit_ends(ends: RingEnds, T: Floats, labels: Ints) -> list[EndsFit]:
    """Fit the pose in the plane, the offset and the blooming to the ring ends, and two strains on top, in B scans.

    Each end stands for the middle of its interval, with the interval's variance beside its own: no label, no rival
    and no robust weight of the estimate itself hides a residual.

    Args:
        ends: of the scans.
        T: (B, 4, 4) T_target_lidar near the best.
        labels: (B, M) edge of each ring end.
    """
    g, there = ends.geometry(T, labels), ends.there & ~ends.outer
    sd = np.sqrt(g.own + g.along**2 * (ends.width**2 / 12 + ends.ring_shift**2))
    boundary = ends.points + ends.middle[..., None] * ends.outward(T)
    at = apply(T, boundary)
    ny, nz = g.direction[..., 1], g.direction[..., 2]
    pose = [ny, nz, (nz * at[..., 1] - ny * at[..., 2]) / ends.circumradius[:, None]]
    common = [g.across * ends.offset_sd[:, None], -g.along * ends.by_shift[..., 0]]
    strains, residual = ends.strains(labels, boundary, T), g.residual + g.along * ends.middle
    rows = np.stack([*pose, *common, strains[..., 0], strains[..., 1], residual], axis=-1)
    rows *= (there / sd)[..., None]
    A, r, prior = rows[..., :5], rows[..., 7:], np.diag([1e-6, 1e-6, 1e-6, 1.0, 1.0])
    weight = np.ones_like(r)
    for _ in range(_REWEIGHTINGS):
        weighted = np.swapaxes(weight * A, 1, 2)
        x = -np.linalg.solve(weighted @ A + prior, weighted @ r)
        residual = A @ x + r
        weight = 1.0 / np.maximum(np.abs(residual) / _HUBER, 1.0)
    count = there.sum(axis=1).tolist()
    factors = triangular(np.concatenate([np.sqrt(weight) * rows, np.broadcast_to(_PRIORS, (len(T), 2, 8))], axis=1))
    return [
        EndsFit(
            residual[k, :n, 0], sd[k, :n], float(x[k, 3, 0]), float(x[k, 4, 0]), max(n - 3, 0), *_strain(factors[k], n)
        )
        for k, n in enumerate(count)
    ]


def _strain(R: Floats, n: int) -> tuple[float, float]:
    """Size of the two strains in a triangular factor (8, 8) of n whitened rows, and the F test of their presence."""
    freedom, pivots = n + 2 - 7, np.abs(np.diag(R)[:7])
    if freedom < 3 or pivots.min() < 1e-6 * pivots.max():
        return 0.0, 1.0
    x = np.linalg.solve(R[5:7, 5:7], R[5:7, 7])
    F = float((R[5:7, 7] ** 2).sum()) / 2 / max(float(R[7, 7] ** 2) / freedom, 1.0)
    return float(np.hypot(*x)), f_tail(F, 2, freedom)


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
