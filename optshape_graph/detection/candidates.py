"""Candidates: patches grown to all connected returns in their plane, without arms and poles; and their size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import pdist

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.detection.options import DetectionOptions
from optshape_graph.detection.patches import Patch
from optshape_graph.detection.segments import OrderedScan, Runs, find_borders, find_runs
from optshape_graph.groups import Groups
from optshape_graph.plane import ReturnsPlane, fit_planes
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class Candidate(Value):
    """Connected returns in one plane.

    Attributes:
        rows: (N,) of the ordered scan.
        ends: (2 M,) those at which rings begin, then those at which they end.
        plane: through them.
        area: square metres that their beams cover, gaps of lost returns included.
        centroid: (2,) of that area, along the plane's axes, metres.
        spread: (2,) standard deviations of that area along its principal axes, the smaller first, metres.
        n_rings: rings that have returns on it.
        cut: whether it reaches the sensor's lowest or highest ring, so that part of it may be out of view.
        hidden: whether something stands before part of its outline.
        stepped: share of the ends of its rings beyond which the range jumps back, or nothing returns.
    """

    rows: Ints
    ends: Ints
    plane: ReturnsPlane
    area: float
    centroid: Floats
    spread: Floats
    n_rings: int
    cut: bool
    hidden: bool
    stepped: float


@dataclass(frozen=True, eq=False, repr=False)
class _Growing(Value):
    """A patch that grows.

    Attributes:
        of_patch: (S,) whether each segment of the scan is the patch's.
        near: (K,) rows of the ordered scan that may belong to it.
        points: (K, 3) of these, metres.
        rows: (N,) of the ordered scan that belong to it by now.
    """

    of_patch: Bools
    near: Ints
    points: Floats
    rows: Ints

    @classmethod
    def of(cls, scan: OrderedScan, patch: Patch, reach: float) -> _Growing:
        of_patch = np.zeros(len(scan.first), dtype=bool)
        of_patch[patch.segments] = True
        near = scan.near(patch.centre, reach)
        return cls(of_patch, near, scan.points.take(near, axis=0), near[of_patch[scan.segment[near]]])

    def grown(self, scan: OrderedScan, plane: ReturnsPlane) -> _Growing:
        """Return the patch with all returns in a plane that are connected with it."""
        off = self.points @ plane.axes[0] - plane.distance
        runs = find_runs(scan, self.near[np.abs(off) < scan.band(plane.axes[0], plane.centre)])
        return replace(self, rows=runs.rows[_connected(scan, runs, self.of_patch)])


def grow(scan: OrderedScan, patches: Sequence[Patch], reach: float) -> list[Candidate]:
    """Grow patches to all returns in their planes that are connected with them.

    Those whose returns do not span a plane, or one that is seen edge-on, are left out.

    Args:
        scan: the ordered scan.
        patches: where to start.
        reach: largest distance from a patch's centre, metres.
    """
    growing = [_Growing.of(scan, patch, reach) for patch in patches]
    for _ in range(2):
        grown = [(one.grown(scan, plane), plane) for one, plane in _in_planes(scan, growing)]
        growing = [one for one, _ in grown]
    trimmed = [
        replace(one, rows=one.rows[without_limbs(scan, one.rows, plane)]) for one, plane in grown if len(one.rows)
    ]
    return [_candidate(scan, find_runs(scan, one.rows), plane) for one, plane in _in_planes(scan, trimmed)]


def _in_planes(scan: OrderedScan, growing: Sequence[_Growing]) -> list[tuple[_Growing, ReturnsPlane]]:
    """Return patches with the planes through their returns, those that span one."""
    some = [one for one in growing if len(one.rows)]
    if not some:
        return []
    rows, groups = np.concatenate([one.rows for one in some]), Groups.of([one.rows for one in some])
    ring = groups.of_row * len(scan.elevations) + scan.ring[rows]
    weights = (1.0 / (1.0 + np.bincount(ring)))[ring]
    planes = fit_planes(scan.points.take(rows, axis=0), weights, groups)
    return [(one, plane) for one, plane in zip(some, planes, strict=True) if isinstance(plane, ReturnsPlane)]


def _candidate(scan: OrderedScan, runs: Runs, plane: ReturnsPlane) -> Candidate:
    area, centroid, spread = _covered_area(scan, runs, plane)
    borders = find_borders(scan, runs.ends)
    return Candidate(
        rows=runs.rows,
        ends=runs.ends,
        plane=plane,
        area=area,
        centroid=centroid,
        spread=spread,
        n_rings=len(runs.ends) // 2,
        cut=bool(runs.ring[0] == 0 or runs.ring[-1] == len(scan.elevations) - 1),
        hidden=bool(borders.hidden.any()),
        stepped=float(borders.open.mean()),
    )


def _connected(scan: OrderedScan, runs: Runs, of_patch: Bools) -> Bools:
    """Return (N,) whether each return's run has some of a patch, or overlaps one that has and is few rings away.

    Runs further away are left out, such as the pole of a stand below a target.

    Args:
        scan: the ordered scan.
        runs: of the returns.
        of_patch: (S,) whether each segment of the scan is the patch's.
    """
    if len(runs.rows) == 0:
        return np.zeros(0, dtype=bool)
    seeded = np.logical_or.reduceat(of_patch[scan.segment[runs.rows]], runs.first)
    left, right = runs.azimuth[runs.last], runs.azimuth[runs.first]
    slack = scan.resolution.step
    overlap = (left[:, None] + slack >= right[seeded]) & (left[seeded] + slack >= right[:, None])
    near = np.abs(runs.ring[:, None] - runs.ring[seeded]) <= scan.options.rings_apart
    return np.repeat((overlap & near).any(axis=1), runs.last - runs.first + 1)


def _covered_area(scan: OrderedScan, runs: Runs, plane: ReturnsPlane) -> tuple[float, Floats, Floats]:
    """Return the area in the plane that the beams of the runs cover, square metres, its centroid (2,) and spread (2,).

    A beam's solid angle cos(e) da de covers r^2 cos(e) da de / cos(incidence).
    """
    points, count = scan.points[runs.rows], runs.last - runs.first + 1
    x, y, _ = points.T
    density = scan.range[runs.rows] ** 2 * np.hypot(x, y) / np.abs(points @ plane.axes[0])
    width = runs.azimuth[runs.last] - runs.azimuth[runs.first] + scan.resolution.step
    of_run = np.repeat(width * scan.ring_heights[runs.ring] / count, count)
    weight = density * of_run
    yz = (points - plane.centre) @ plane.axes[1:].T
    area = float(weight.sum())
    centroid = weight @ yz / area
    yz -= centroid
    return area, centroid, np.sqrt(np.linalg.eigvalsh((yz * weight[:, None]).T @ yz / area).clip(min=0.0))


def without_limbs(scan: OrderedScan, rows: Ints, plane: ReturnsPlane) -> Bools:
    """Return (N,) which returns (N,) of a surface are not on an arm, a handle or a stand.

    The side of a convex outline is a concave function of height: it is nowhere further out than the line through two
    points of it above, or below. The two points are a limb's thickness apart, so that they are not on the same limb;
    the median of several such lines counts, since some may touch a limb.
    """
    ends = find_runs(scan, rows).ends
    n_rings = len(ends) // 2
    at = (scan.points[ends] - plane.centre) @ plane.axes[1:].T
    height = at[:, 1].reshape(2, n_rings)
    distance = float(np.linalg.norm(plane.centre))
    cos_incidence = abs(float(plane.axes[0] @ plane.centre) / distance)
    slack = scan.options.limb_slack * scan.resolution.step * distance / cos_incidence
    rise = float(np.median(np.abs(np.diff(height.mean(axis=0))))) if n_rings > 1 else 0.0
    apart = int(np.ceil(scan.options.thickest_limb / rise)) if rise > 0 else n_rings
    if 2 * apart >= n_rings:
        return np.ones(len(rows), dtype=bool)
    left, of_return = (scan.points[rows] - plane.centre) @ plane.axes[1], scan.ring[rows]
    ring = (np.cumsum(np.bincount(of_return) > 0) - 1)[of_return]
    keep = np.ones(len(rows), dtype=bool)
    for side, end, z in zip((-1.0, 1.0), at[:, 0].reshape(2, n_rings), height, strict=True):
        lines = [
            line
            for near, far in ((1, 2), (1, 3), (2, 3))
            for line in (
                _beyond(side * end, z, near * apart, far * apart),
                _beyond((side * end)[::-1], z[::-1], near * apart, far * apart)[::-1],
            )
        ]
        reach = _middle(np.array(lines))
        keep &= ~(side * left > reach[ring] + slack)  # NaN: nothing to compare with
    return keep


def _middle(lines: Floats) -> Floats:
    """Return the median (M,) over lines (L, M), the upper of two; NaN where all are NaN."""
    count = np.isfinite(lines).sum(axis=0)
    return np.asarray(np.sort(lines, axis=0)[np.minimum(count // 2, len(lines) - 1), np.arange(lines.shape[1])])


def _beyond(end: Floats, height: Floats, near: int, far: int) -> Floats:
    """Return where the line through the ends `near` and `far` rings on meets each ring (M,); NaN: no such rings."""
    meets = np.full(len(end), np.nan)
    count = len(end) - far
    if count > 0:
        slope = (end[near : near + count] - end[far:]) / (height[near : near + count] - height[far:])
        meets[:count] = end[far:] + slope * (height[:count] - height[far:])
    return meets


@dataclass(frozen=True, eq=False, repr=False)
class Size(Value):
    """Measures of a polygon that do not depend on its rotation.

    Attributes:
        area: square metres.
        spread: (2,) standard deviations of the area along its principal axes, the smaller first, metres.
        diameter: largest distance of two vertices, metres.
        width: smallest distance of two parallel lines with the polygon between them, metres.
    """

    area: float
    spread: Floats
    diameter: float
    width: float

    @classmethod
    def of(cls, target: Target) -> Size:
        """Measure a target."""
        polygon = target.polygon
        following = np.roll(polygon, -1, axis=0)
        # Green's theorem, triangle by triangle from the origin.
        triangles = 0.5 * (polygon[:, 0] * following[:, 1] - following[:, 0] * polygon[:, 1])
        centroid = triangles @ (polygon + following) / (3.0 * target.area)
        a, b = polygon, following
        second = np.einsum("k,kij->ij", triangles / 6.0, a[:, :, None] * a[:, None] + b[:, :, None] * b[:, None])
        cross = np.einsum("k,kij->ij", triangles / 12.0, a[:, :, None] * b[:, None] + b[:, :, None] * a[:, None])
        covariance = (second + cross) / target.area - np.outer(centroid, centroid)
        across = target.offsets - (polygon @ target.normals.T).min(axis=0)
        return cls(
            target.area, np.sqrt(np.linalg.eigvalsh(covariance)), float(pdist(polygon).max()), float(across.min())
        )

    def objection(self, candidate: Candidate, options: DetectionOptions) -> str:
        """Return why a candidate cannot be of this size; empty: it can.

        At the top and the bottom, rings cover a surface to within half the spacing of rings.
        """
        most = 1.0 + options.size_excess + 0.5 / candidate.n_rings
        seen = (
            options.size_seen_cut
            if candidate.cut
            else options.size_seen_hidden
            if candidate.hidden
            else options.size_seen
        )
        least = seen - 0.5 / candidate.n_rings
        area = candidate.area / self.area
        if not least <= area <= most:
            return f"covers {candidate.area:.2f} m2, the target {self.area:.2f} m2"
        ratio = candidate.spread / self.spread
        if not (least <= ratio.min() and ratio.max() <= most):
            return (
                f"spreads {candidate.spread[0]:.2f} x {candidate.spread[1]:.2f} m, "
                f"the target {self.spread[0]:.2f} x {self.spread[1]:.2f} m"
            )
        return ""
