"""The motion of a polygon's edge points along the rings when the polygon moves (paper, Section III-C).

An edge with slope m = dx/dy meets the ring at height y in x = x_i + m (y - y_i). Moving the polygon by (omega, u, v) of
se(2), with the ring fixed, moves that point along the ring by

    v_x = omega (-y - m x) + u - m v

(the sign of the last term is minus; the published one is plus). It is linear in the motion, v_x = J . (omega, u, v), so
the sum of v_x^2 over the edge points is a quadratic form and its minimum over the unit sphere is the smallest
eigenvalue of A = sum J J^T, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Floats, Value
from optshape_graph.design.polygons import strictly_convex
from optshape_graph.design.rings import Rings

MU = 1e-3
"""Weight of the chords in the published score."""


@dataclass(frozen=True, eq=False, repr=False)
class EdgeCrossings(Value):
    """Crossings of k rings in each of m areas with the n edges of polygons (..., n, 2), in their unit.

    Attributes:
        hit: (k, n, ..., m) whether the ring meets the edge: for a convex polygon, two edges of n or none.
        x: (k, n, ..., m) abscissa of the edge point in the polygons' unit, 0 where there is none.
        y: (k, 1, ..., m) height of the ring in the polygons' unit.
        slope: (n, ..., 1) m = dx/dy of the edge, a ratio, 0 where it is level.
        side: (n, ..., 1) the number +1 for an edge at the right end of its chords, -1 at the left.
    """

    hit: Bools
    x: Floats
    y: Floats
    slope: Floats
    side: Floats

    @property
    def turning(self) -> Floats:
        """(k, n, ..., m) -y - m x: motion of the edge point under unit omega; 0 where there is none."""
        return np.where(self.hit, -self.y - self.slope * self.x, 0.0)

    @property
    def chords(self) -> Floats:
        """(k, ..., m) distances d between the two edge points of each ring, in the polygons' unit."""
        return np.asarray((self.side * self.x).sum(axis=1))

    def motion(self, motions: Floats) -> Floats:
        """(k, n, ..., m, g) v_x of the edge points under (g, 3) unit motions (omega, u, v); 0 where there is none."""
        omega, u, v = motions.T
        return np.asarray(self.turning[..., None] * omega + self.hit[..., None] * (u - self.slope[..., None] * v))


def edge_crossings(polygons: Floats, heights: Floats) -> EdgeCrossings:
    """Return where horizontal rings cross the edges of polygons (eq. 10).

    Args:
        polygons: (..., n, 2) vertices, in any unit.
        heights: (k, ..., m) ring heights, in the same unit.
    """
    x0, y0 = (np.moveaxis(polygons[..., axis], -1, 0)[..., None] for axis in (0, 1))
    dx, dy = np.roll(x0, -1, axis=0) - x0, np.roll(y0, -1, axis=0) - y0
    slope = np.divide(dx, dy, out=np.zeros_like(dx), where=dy != 0)
    y = heights[:, None]
    # Half-open, so that a ring through a vertex meets one of its two edges.
    hit = (y >= np.minimum(y0, y0 + dy)) & (y < np.maximum(y0, y0 + dy))
    x = np.where(hit, x0 + slope * (y - y0), 0.0)
    return EdgeCrossings(hit, x, y, slope, np.sign(dy))


def quadratic_forms(crossings: EdgeCrossings) -> Floats:
    """Return A = sum J J^T (..., m, 3, 3) over the edge points of each area, J = (-y - m x, 1, -m)."""
    turning, m = crossings.turning, crossings.slope
    count, first, second = crossings.hit.sum(axis=0), turning.sum(axis=0), (turning * turning).sum(axis=0)
    oo, ou, ov = second.sum(axis=0), first.sum(axis=0), -(m * first).sum(axis=0)
    uu, uv, vv = count.sum(axis=0), -(m * count).sum(axis=0), (m * m * count).sum(axis=0)
    return np.stack([oo, ou, ov, ou, uu, uv, ov, uv, vv], axis=-1).reshape(*oo.shape, 3, 3)


def cell_scores(polygons: Floats, rings: Rings, mu: float = MU) -> Floats:
    """Return the score w M + mu sum d (..., m) of each area under its worst unit motion (eqs. 15 and 16).

    M is the smallest eigenvalue of A over the polygon's height h; w is its width. The unit sphere of motions mixes
    radians and lengths, so the score depends on the unit of length and on the origin: published values are for unit
    area. Rings that meet no edge contribute nothing; a polygon that is not strictly convex and counter-clockwise
    scores 0.

    Args:
        polygons: (..., n, 2) vertices in units of the root of the area, turned as the rings see them, about the point
            that omega turns about.
        rings: the rings.
        mu: weight of the chords.
    """
    low, high = polygons[..., 1].min(axis=-1), polygons[..., 1].max(axis=-1)
    crossings = edge_crossings(polygons, rings.heights(low, high))
    smallest = np.linalg.eigvalsh(quadratic_forms(crossings))[..., 0].clip(min=0.0)
    w_over_h = np.ptp(polygons[..., 0], axis=-1) / (high - low)
    scores = w_over_h[..., None] * smallest + mu * crossings.chords.sum(axis=0)
    return np.where(strictly_convex(polygons)[..., None], scores, 0.0)


def worst_motions(polygons: Floats, rings: Rings) -> Floats:
    """Return the unit motion (omega, u, v) (..., m, 3) under which the edge points of each area move least."""
    low, high = polygons[..., 1].min(axis=-1), polygons[..., 1].max(axis=-1)
    forms = quadratic_forms(edge_crossings(polygons, rings.heights(low, high)))
    return np.asarray(np.linalg.eigh(forms)[1][..., 0])
