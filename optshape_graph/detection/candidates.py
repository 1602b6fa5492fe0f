"""Candidates: planar patches grown to all returns in their plane, and a first look at their size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints
from optshape_graph._value import Value
from optshape_graph.detection.borders import borders
from optshape_graph.detection.limbs import without_limbs
from optshape_graph.detection.patches import RINGS_APART, Patch
from optshape_graph.detection.runs import Runs, find_runs
from optshape_graph.detection.segments import Sweep
from optshape_graph.errors import EstimationError
from optshape_graph.pose.association import ReturnsPlane, fit_plane


@dataclass(frozen=True, eq=False, repr=False)
class Candidate(Value):
    """Connected returns in one plane.

    Attributes:
        rows: (N,) of the sweep.
        core: (K,) those of the patch it grew from: without tips that few returns are on, and without bits of a stand.
        plane: through them.
        area: square metres that their beams cover, gaps of lost returns included.
        spread: (2,) standard deviations of that area along its principal axes, the smaller first, metres.
        n_rings: rings that have returns on it.
        cut: it reaches the sensor's lowest or highest ring: part of it may be out of view.
        hidden: something stands before part of its outline.
        stepped: share of the ends of its rings beyond which the range jumps back, or nothing returns.
    """

    rows: Ints
    core: Ints
    plane: ReturnsPlane
    area: float
    spread: Floats
    n_rings: int
    cut: bool
    hidden: bool
    stepped: float


def grow(sweep: Sweep, patch: Patch, reach: float) -> Candidate:
    """Grow a patch to all returns in its plane that are connected with it.

    Args:
        sweep: the scan.
        patch: where to start.
        reach: metres from the patch's centre, at most.

    Raises:
        EstimationError: the returns do not span a plane, or it is seen edge-on.
    """
    of_patch = np.zeros(len(sweep.first), dtype=bool)
    of_patch[patch.segments] = True
    seed = of_patch[sweep.segment]
    near = sweep.near(patch.centre, reach)
    member = near[seed[near]]
    for _ in range(2):
        plane = fit_plane(sweep.points[member], sweep.ring[member])
        off = (sweep.points[near] - plane.centre) @ plane.axes[0]
        band = sweep.resolution.band(float(plane.axes[0] @ plane.centre / np.linalg.norm(plane.centre)))
        runs = find_runs(sweep, near[np.abs(off) < band])
        keep = _connected(sweep, runs, seed)
        member = runs.rows[keep]
    if len(member) == 0:
        raise EstimationError("no returns in its plane")
    member = member[without_limbs(sweep, member, plane)]
    runs = find_runs(sweep, member)
    plane = fit_plane(sweep.points[member], sweep.ring[member])
    area, spread = _covered_area(sweep, runs, plane)
    ends = borders(sweep, member)
    return Candidate(
        rows=runs.rows,
        core=runs.rows[seed[runs.rows]],
        plane=plane,
        area=area,
        spread=spread,
        n_rings=len(np.unique(runs.ring)),
        cut=bool(runs.ring[0] == 0 or runs.ring[-1] == len(sweep.elevations) - 1),
        hidden=bool(ends.hidden.any()),
        stepped=float(ends.open.mean()),
    )


def _connected(sweep: Sweep, runs: Runs, seed: Bools) -> Bools:
    """(N,) whether each return's run holds a seed, or overlaps one that does, a ring or two away.

    No further: what hangs on to a target, like the pole of its stand, is left out.
    """
    if len(runs.rows) == 0:
        return np.zeros(0, dtype=bool)
    seeded = np.logical_or.reduceat(seed[runs.rows], runs.first)
    left, right = runs.azimuth[runs.last], runs.azimuth[runs.first]
    slack = sweep.resolution.step
    overlap = (left[:, None] + slack >= right[seeded]) & (left[seeded] + slack >= right[:, None])
    near = np.abs(runs.ring[:, None] - runs.ring[seeded]) <= RINGS_APART
    return np.repeat((overlap & near).any(axis=1), runs.last - runs.first + 1)


def _covered_area(sweep: Sweep, runs: Runs, plane: ReturnsPlane) -> tuple[float, Floats]:
    """Area in the plane that the beams of the runs stand for, square metres, and its spread (2,).

    A beam's solid angle cos(e) da de covers r^2 cos(e) da de / cos(incidence).
    """
    points, count = sweep.points[runs.rows], runs.last - runs.first + 1
    density = (points**2).sum(axis=1) * np.hypot(points[:, 0], points[:, 1]) / np.abs(points @ plane.axes[0])
    width = runs.azimuth[runs.last] - runs.azimuth[runs.first] + sweep.resolution.step
    of_run = np.repeat(width * sweep.ring_heights[runs.ring] / count, count)
    weight = density * of_run
    yz = (points - plane.centre) @ plane.axes[1:].T
    area = float(weight.sum())
    yz -= weight @ yz / area
    return area, np.sqrt(np.linalg.eigvalsh((yz * weight[:, None]).T @ yz / area).clip(min=0.0))
