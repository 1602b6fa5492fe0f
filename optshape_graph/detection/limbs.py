"""Arms, handles and stands in a target's plane: what sticks out of a convex outline on a few rings."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints
from optshape_graph.detection.runs import ring_ends
from optshape_graph.detection.segments import Sweep
from optshape_graph.pose.association import ReturnsPlane

THICKEST_LIMB = 0.12
"""Width of what is taken for an arm or a pole, metres."""

SLACK_STEPS = 3.0
"""Azimuth steps by which a line through two ring ends may miss where it meets a third ring."""


def without_limbs(sweep: Sweep, rows: Ints, plane: ReturnsPlane) -> Bools:
    """(N,) whether returns (N,) of a surface are within what its other rings let it reach.

    The side of a convex outline is a concave function of height: nowhere is it further out than the line through two
    points of it above, or below. Those are taken a limb's thickness apart, so that one limb does not vouch for itself;
    of several such lines the middle one counts, since some may lean on a limb.
    """
    ends = ring_ends(sweep, rows)
    n_rings = len(ends) // 2
    at = (sweep.points[ends] - plane.centre) @ plane.axes[1:].T
    height = at[:, 1].reshape(2, n_rings)
    distance = float(np.linalg.norm(plane.centre))
    slack = SLACK_STEPS * sweep.resolution.step * distance / abs(float(plane.axes[0] @ plane.centre) / distance)
    rise = float(np.median(np.abs(np.diff(height.mean(axis=0))))) if n_rings > 1 else 0.0
    apart = int(np.ceil(THICKEST_LIMB / rise)) if rise > 0 else n_rings
    if 2 * apart >= n_rings:
        return np.ones(len(rows), dtype=bool)
    yz = (sweep.points[rows] - plane.centre) @ plane.axes[1:].T
    _, ring = np.unique(sweep.ring[rows], return_inverse=True)
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
        keep &= ~(side * yz[:, 0] > reach[ring] + slack)  # not a number: nothing to compare with
    return keep


def _middle(lines: Floats) -> Floats:
    """(M,) median over lines (L, M), the upper of two; not a number where none of them is one."""
    count = np.isfinite(lines).sum(axis=0)
    return np.asarray(np.sort(lines, axis=0)[np.minimum(count // 2, len(lines) - 1), np.arange(lines.shape[1])])


def _beyond(end: Floats, height: Floats, near: int, far: int) -> Floats:
    """(M,) where the line through the ends `near` and `far` rings on meets each ring; not a number: no such."""
    meets = np.full(len(end), np.nan)
    count = len(end) - far
    if count > 0:
        slope = (end[near : near + count] - end[far:]) / (height[near : near + count] - height[far:])
        meets[:count] = end[far:] + slope * (height[:count] - height[far:])
    return meets
