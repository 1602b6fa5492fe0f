"""What ring ends say of the pose under associations of theirs: rows linear in it, and in what scans share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.edges import UP
from optshape_graph.factors._rows import triangular_by_parts
from optshape_graph.factors.measurement import template_rows
from optshape_graph.factors.static import (
    BLOOMING,
    EDGE_OFFSET,
    OUTER_EDGE,
    STRAIN,
    BiasedMeasurement,
    SharedError,
    angle_errors,
)
from optshape_graph.pose.ends.posterior import Posterior
from optshape_graph.pose.ends.ring_ends import EdgeGeometry, Problem, RingEnds


@dataclass(frozen=True, eq=False, repr=False)
class EdgeRows(Value):
    """Boundary points against their edges under A associations, in metres.

    They share the offset across the edges, the blooming, and the strains of an outline that isn't as drawn; those of a
    ring the errors of its elevation and of its azimuth.

    Attributes:
        T_target_lidar: (A, 4, 4) the poses, those of a scan likeliest first.
        pose: (A, M, 13) rows linear in [z; 1].
        common: (A, M, 4) how far a standard deviation of the offset, one of the blooming, and either strain of unit
            size move each.
        own: (A, M) standard deviation of what each scan draws anew, metres.
        outer: (A, M) standard deviation of where the target ends before the next ring, metres, the same in all scans.
        sigma: (A, M) standard deviation of both, metres.
        geometry: of the ring ends.
    """

    T_target_lidar: Floats
    pose: Floats
    common: Floats
    own: Floats
    outer: Floats
    sigma: Floats
    geometry: EdgeGeometry

    @classmethod
    def of(cls, ends: RingEnds, posterior: Posterior) -> EdgeRows:
        """Make them of posteriors, and of the ring ends of the scan that each is of."""
        g, T = posterior.geometry, posterior.T_target_lidar
        boundary = ends.points + posterior.inset[..., None] * ends.outward(T)
        offsets = np.take_along_axis(ends.offsets, g.labels, axis=1) + g.shift
        A, r = template_rows(boundary.reshape(-1, 3), g.direction.reshape(-1, 3), offsets.ravel())
        offset, blooming = g.across * ends.offset_sd[:, None], -g.along * ends.by_shift[..., 0]
        strains = ends.strains(g.labels, boundary, T)
        common = np.stack([offset, blooming, strains[..., 0], strains[..., 1]], axis=-1)
        variance = np.maximum(posterior.sigma**2 - g.of_ring, 0.1 * posterior.sigma**2)
        own = np.where(ends.outer, np.clip(g.own - g.of_ring, 1e-2 * variance, variance), variance)
        return cls(
            T_target_lidar=T,
            pose=np.column_stack([A, r]).reshape(*g.labels.shape, 13),
            common=common,
            own=np.sqrt(own),
            outer=np.sqrt(variance - own),
            sigma=np.sqrt(variance),
            geometry=g,
        )

    def measurement(
        self, mine: slice, weight: Floats, problem: Problem, strain: float, factor: float
    ) -> tuple[BiasedMeasurement, float]:
        """Return what the edges of a scan say, before what they share is marginalised; and their weight.

        Args:
            mine: the associations of the scan.
            weight: (K,) of each, summing to 1: a weighted mean of their costs is a cost of the same form.
            problem: the scan's.
            strain: of the outline, as far as it is seen.
            factor: on standard deviations of ring ends.

        Returns:
            The measurement, and the sum of 1 / sigma^2, 1/m2.
        """
        edges, g = problem.edges, self.geometry
        part = mine, slice(len(edges))
        outside = np.abs(edges.side) == UP
        ring = np.tile(edges.ring, len(weight))
        by_angle, angles = angle_errors(g.lifted[part].ravel(), g.turned[part].ravel(), ring, problem.sensor)
        columns = [
            self.common[part] * [1.0, 1.0, strain, strain],
            self.outer[part][..., None] * np.eye(len(edges))[:, outside],
            by_angle.reshape(len(weight), len(edges), -1),
            self.pose[part],
        ]
        sd = factor * self.own[part]
        rows = np.concatenate(columns, axis=-1) * (np.sqrt(weight)[:, None] / sd)[..., None]
        if problem.ring_shifts.shape[1]:
            rows = _without_shifts(problem.ring_shifts * (g.along[part] / self.own[part])[..., None], rows)
        stack = rows.reshape(-1, rows.shape[-1])
        shared = [
            *(SharedError(kind) for kind in (EDGE_OFFSET, BLOOMING, *STRAIN)),
            *(SharedError(OUTER_EDGE, ring=ring) for ring in edges.ring[outside].tolist()),
            *angles,
        ]
        factor_of_rows = triangular_by_parts(stack, len(shared))
        measurement = BiasedMeasurement(factor_of_rows, len(edges), self.T_target_lidar[mine.start], tuple(shared))
        return measurement, float(weight @ (1 / (factor * self.sigma[part]) ** 2).sum(axis=1))


def _without_shifts(B: Floats, rows: Floats) -> Floats:
    """Whiten rows (A, M, n) which unit-variance errors share, columns B (A, M, K) of disjoint rows."""
    square = (B**2).sum(axis=1, keepdims=True)
    share = np.where(square > 0, (1 - 1 / np.sqrt(1 + square)) / np.maximum(square, 1e-300), 0.0)
    return np.asarray(rows - (B * share) @ (np.swapaxes(B, 1, 2) @ rows))
