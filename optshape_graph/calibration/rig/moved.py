"""Targets that were said to stay, and moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.rig.graph import RigGraph
from optshape_graph.calibration.rig.judgement import scatter_of
from optshape_graph.calibration.rig.left_out import dense_information, inverted, rows_of
from optshape_graph.calibration.rig.sightings import Sighting
from optshape_graph.calibration.rig.solution import RigSolution
from optshape_graph.calibration.rig.solve import solve_graph
from optshape_graph.calibration.rig.start import Start
from optshape_graph.calibration.verdict import Finding
from optshape_graph.errors import EstimationError
from optshape_graph.se3 import angle, difference, exp, inverse

FARTHEST, WIDEST = 0.02, np.radians(2.0)
"""Distance, metres, or angle, rad, that a target has moved by at least."""

UNLIKELY = 40.0
"""Chi-square, six degrees of freedom, of a target that has moved, at least."""

FEWEST = 2
"""Moments at which a target must have been seen before it moved, and after, to be told from a wrong sighting."""

MOST = 20
"""Targets that moved, and wrong sightings, that are looked for."""

TOLD = 1e-9
"""Information on how a target moved, relative to the largest, under which nothing tells it."""

SLACK = np.diag([np.radians(1.0) ** 2] * 3 + [0.01**2] * 3)
"""Covariance that stands for what the covariances of one LiDAR's sightings leave out."""


class Moved(NamedTuple):
    """A target that moved, or a sighting that is wrong.

    Attributes:
        gain: chi-square that it explains.
        step: (6,) by how much the target moved, its own frame, rotation first, rad and metres.
        placement: of the target; "" for a wrong sighting.
        about: numbers of the sightings before and after; of a wrong one its own, twice.
    """

    gain: float
    step: Floats
    placement: str
    about: tuple[int, int]

    @property
    def anew(self) -> str:
        """Its placement after it moved."""
        return f"{self.placement}#{self.about[1]}"


def moved_before_platform(sightings: Sequence[Sighting]) -> tuple[list[Sighting], list[Finding]]:
    """Find targets that moved in view of a platform that stands still: one of its sensors sees them elsewhere.

    Args:
        sightings: of targets that were said to stay, and of others.

    Returns:
        The sightings, those of a target after it moved being of another placement; and what was found.
    """
    tracks: dict[tuple[str, str], list[Sighting]] = {}
    for sighting in sightings:
        tracks.setdefault((sighting.placement, sighting.sensor), []).append(sighting)
    broken: dict[str, dict[int, str]] = {}  # by placement and moment
    for (placement, _), track in tracks.items():
        moments = {s.moment: s for s in sorted(track, key=lambda s: s.moment)}
        for before, after in pairwise(moments.values()):
            x, square = _apart(before, after)
            if _far(x) and square > UNLIKELY:
                broken.setdefault(placement, {}).setdefault(after.moment, _in_words(x, before, after))
    split = [_after(s, sum(moment <= s.moment for moment in broken.get(s.placement, ()))) for s in sightings]
    return split, [_finding(name, [texts[k] for k in sorted(texts)]) for name, texts in broken.items()]


def moved_about_platform(graph: RigGraph) -> tuple[RigGraph, list[Finding]]:
    """Find targets that moved while the platform did: all else being free, the sightings fit far better if one did.

    Of every target and moment, the rise of the likelihood if it moved then is that of a linear model (Rao's score
    test); so is that of every sighting being wrong, which is the other explanation and has to explain less.

    Args:
        graph: of a platform that moves.

    Returns:
        The graph, the sightings of a target after it moved being of another placement, and wrong ones strangers; and
        what was found.
    """
    wrong, found = set[int](), list[Moved]()  # strangers of the start may be of a target that moved
    for _ in range(MOST):
        solved = _solved(graph, wrong)
        scatter, freedom = scatter_of(solved)
        best = _likeliest(solved)
        if best is None or best.gain < UNLIKELY * max(1.0, scatter - best.gain / freedom):
            break
        if best.placement and not _far(best.step):
            break
        if best.placement:
            found.append(best)
            graph = replace(graph, start=_placed_anew(graph.start, best))
        else:
            wrong.add(best.about[0])
    else:
        solved = _solved(graph, wrong)
    texts: dict[str, list[str]] = {}
    for one in found:
        keys = [graph.placements[placement] for placement in (one.placement, one.anew)]
        x = difference(*(solved.solution.pose(key) for key in keys))
        before, after = (graph.start.sightings[n] for n in one.about)
        texts.setdefault(before.target.name, []).append(_in_words(x, before, after))
    graph = replace(graph, start=replace(graph.start, strangers=frozenset(wrong)))
    return graph, [_finding(name, said) for name, said in texts.items()]


def _solved(graph: RigGraph, wrong: set[int]) -> RigSolution:
    """The solution without the loss, and without the sightings that are wrong; nor strangers, if there is none else."""
    everything, quadratic = set(range(len(graph.start.sightings))), replace(graph, loss=np.inf)
    try:
        return solve_graph(quadratic, everything - wrong)
    except EstimationError:
        wrong |= graph.start.strangers
        return solve_graph(quadratic, everything - wrong)


def _placed_anew(start: Start, moved: Moved) -> Start:
    """The start, a target being of another placement from the moment on at which it moved."""
    first = start.sightings[moved.about[1]].moment
    sightings = tuple(
        replace(s, placement=moved.anew) if s.placement == moved.placement and s.moment >= first else s
        for s in start.sightings
    )
    placed = {**start.T_world_target, moved.anew: start.T_world_target[moved.placement] @ exp(moved.step)}
    return replace(start, sightings=sightings, T_world_target=placed)


def _likeliest(solved: RigSolution) -> Moved | None:
    """What explains most of what sightings are off by: a target that moved, or one of them being wrong."""
    information = dense_information(solved)
    if information is None:
        return None
    covariance, columns = inverted(information, np.diag(information)), solved.solution.system.columns
    rows = {n: rows_of(link, columns, len(information)) for n, link in solved.linked.items()}
    options = [_explained(np.eye(6), rows[n], link.d, covariance, "", (n, n)) for n, link in solved.linked.items()]
    sightings, tracks = solved.graph.start.sightings, dict[str, list[int]]()
    for n in sorted(solved.linked, key=lambda n: sightings[n].moment):
        tracks.setdefault(sightings[n].placement, []).append(n)
    for placement, track in tracks.items():
        key, moments = solved.graph.placements[placement], sorted({sightings[n].moment for n in track})
        for moment in moments[FEWEST : len(moments) - FEWEST + 1]:
            k = next(k for k, n in enumerate(track) if sightings[n].moment == moment)
            J = np.vstack([rows[n][:, columns[key]] for n in track[k:]])
            d, A = np.concatenate([solved.linked[n].d for n in track[k:]]), np.vstack([rows[n] for n in track[k:]])
            options.append(_explained(J, A, d, covariance, placement, (track[k - 1], track[k])))
    return max(options, key=lambda option: option.gain, default=None)


def _explained(J: Floats, A: Floats, d: Floats, covariance: Floats, placement: str, about: tuple[int, int]) -> Moved:
    """What six unknowns more explain, that move the errors d of rows A by J, all others being free."""
    g, left = J.T @ d, J.T @ J - (J.T @ A) @ covariance @ (A.T @ J)
    step = -np.asarray(np.linalg.pinv(left, rcond=TOLD, hermitian=True) @ g)
    return Moved(float(-g @ step), step, placement, about)


def _after(sighting: Sighting, times: int) -> Sighting:
    return replace(sighting, placement=f"{sighting.placement}#{times + 1}") if times else sighting


def _far(x: Floats) -> bool:
    return bool(np.linalg.norm(x[3:]) > FARTHEST or np.linalg.norm(x[:3]) > WIDEST)


def _in_words(x: Floats, before: Sighting, after: Sighting) -> str:
    return (
        f"by {np.linalg.norm(x[3:]):.3f} m and {np.degrees(np.linalg.norm(x[:3])):.1f} deg between {before.file} and "
        f"{after.file}"
    )


def _finding(name: str, texts: Sequence[str]) -> Finding:
    times = f" {len(texts)} times, first" if len(texts) > 1 else ""
    return Finding(
        f"target '{name}' was said to stay, but moved{times} {texts[0]}; from there on it is taken for placed anew",
        False,
    )


def _apart(a: Sighting, b: Sighting) -> tuple[Floats, float]:
    """How far a target is from where it was (6,), rotation first, and squared in standard deviations."""
    A, B = a.candidates[0], b.candidates[0]
    T = B.T_sensor_target
    if a.relative:
        T = a.target.nearest_equivalent(T, A.T_sensor_target)
    else:
        T = min(b.poses, key=lambda pose: float(angle(inverse(A.T_sensor_target) @ pose)))
    x = difference(A.T_sensor_target, T)
    # What is the LiDAR's own, both have.
    return x, float(x @ np.linalg.solve(A.covariance + B.covariance + SLACK, x))
