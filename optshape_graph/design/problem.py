"""The design problem: the shape of the family whose worst score over orientations and areas is largest.

The problem is max over P of min over cells of Psi (eq. 17 with corrected signs and orders). It is non-smooth, since the
worst cell changes. In epigraph form, max t such that Psi_c(P) >= t for every cell c, it is a smooth constrained problem
as long as no ring passes a vertex. Sequential linear programming with a trust region solves it: minimax problems
with few parameters end at a vertex of as many active cells, where it converges quadratically.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linprog

from optshape_graph._arrays import Floats
from optshape_graph.design.family import Family
from optshape_graph.design.limits import Limits
from optshape_graph.design.polygons import centred, rotated
from optshape_graph.design.rings import Rings, UniformRings
from optshape_graph.design.sensitivity import MU, cell_scores

LARGEST = np.array([np.inf, 5.0, np.log(5.0), 10.0, 10.0])
"""Bounds on the magnitudes of the unknowns theta, k, log lambda, v1, v2."""

SMALLEST_DEPTH = 0.02
"""Lower bound on v1 x + v2 y + 1, which excludes shapes that reach to infinity."""

SPREAD = np.array([np.inf, 0.5, 0.4, 0.7, 0.7])
"""Standard deviations of random starts; the rotation is uniform."""

ACTIVE_CELLS = 80
"""Orientations, those with the lowest scores, that enter a linear programme."""

LARGEST_RADIUS, SMALLEST_RADIUS = 0.5, 1e-6
"""Half widths of the trust region, a box about the unknowns."""

MOST_ITERATIONS = 60
SMALLEST_GAIN = 1e-9

MARGIN = 1e-4
"""Relative slack that the solver keeps, so that its result is admissible and not just nearly so."""

PENALTY = 1.0
"""Penalty on the score per unit of violated slack; it exceeds the multipliers, as scores are of the order of 0.01."""


@dataclass(frozen=True)
class Problem:
    """The problem.

    Attributes:
        family: the candidates.
        rings: the rings that light them.
        limits: of the workshop.
        steps: steps between orientations over half a turn (a full turn if the rings are not symmetric), rad. The
            problem is solved with the first step, from there with the second, and so on; the score is that of the last.
        mu: weight of the chords.
    """

    family: Family = field(default_factory=Family)
    rings: Rings = field(default_factory=UniformRings)
    limits: Limits = field(default_factory=Limits)
    steps: tuple[float, ...] = (np.pi / 180, np.pi / 1800)
    mu: float = MU


@dataclass(frozen=True)
class Start:
    """The end of one start of a search.

    Attributes:
        index: number of the start.
        initial: (5,) parameters theta, k, lambda, v1, v2 that it started from.
        parameters: (5,) parameters that it ended at.
        score: worst score there, over the orientations of the last step.
        slack: smallest relative slack of the limits: negative if the end is not admissible.
        iterations: linear programmes solved.
    """

    index: int
    initial: tuple[float, ...]
    parameters: tuple[float, ...]
    score: float
    slack: float
    iterations: int


def orientations(rings: Rings, step: float) -> Floats:
    """Return orientations (R,), rad, `step` apart: over half a turn if the other half only repeats the scores."""
    turn = np.pi if rings.half_turn_symmetric else 2 * np.pi
    return np.arange(0.0, turn - 1e-9, step)


def solve(problem: Problem, initial: Floats, index: int = 0) -> Start:
    """Solve from one start.

    Args:
        problem: the problem.
        initial: (5,) parameters.
        index: number to give the start.
    """
    x = unknowns_of(initial)
    iterations = 0
    for step in problem.steps:
        x, used = _sequential_lp(problem, x, orientations(problem.rings, step))
        iterations += used
    angles = orientations(problem.rings, problem.steps[-1])
    scores, slacks = _evaluate(problem, x[None], angles)
    slack = float(slacks.min()) + MARGIN
    end = tuple(float(value) for value in parameters_of(x[None])[0])
    return Start(index, tuple(map(float, initial)), end, float(scores.min()), slack, iterations)


def random_parameters(problem: Problem, rng: np.random.Generator) -> Floats:
    """Return the parameters (5,) of a random convex member of the family."""
    while True:
        x = np.append(rng.uniform(0.0, 2 * np.pi), SPREAD[1:] * rng.standard_normal(4))
        parameters = parameters_of(x[None])[0]
        if problem.family.depths(parameters).min() > 10 * SMALLEST_DEPTH:
            return np.asarray(parameters)


def _sequential_lp(problem: Problem, x: Floats, angles: Floats) -> tuple[Floats, int]:
    """Maximise the worst score over `angles` from `x`, and count the linear programmes."""
    radius, iterations = 0.2, 0
    scores, slacks = _evaluate(problem, x[None], angles)
    merit = _merit(scores, slacks)[0]
    while radius > SMALLEST_RADIUS and iterations < MOST_ITERATIONS:
        iterations += 1
        lowest = np.argsort(scores[0].min(axis=-1))[:ACTIVE_CELLS]
        trial = _lp_step(problem, x, angles[lowest], radius)
        trial_scores, trial_slacks = _evaluate(problem, trial[None], angles)
        gain = _merit(trial_scores, trial_slacks)[0] - merit
        if gain > 0:
            x, scores, merit = trial, trial_scores, merit + gain
            radius = min(2.0 * radius, LARGEST_RADIUS)
        else:
            radius *= 0.35
        if 0 < gain < SMALLEST_GAIN:
            break
    return x, iterations


def _lp_step(problem: Problem, x: Floats, angles: Floats, radius: float) -> Floats:
    """Maximise t - PENALTY s over a box about x: linearised scores >= t, linearised slacks >= -s."""
    n, h = len(x), 1e-6
    around = np.concatenate([x[None], x + h * np.eye(n), x - h * np.eye(n)])
    scores, slacks = _evaluate(problem, around, angles)
    scores = scores.reshape(len(around), -1)
    keep = np.argsort(scores[0])[:ACTIVE_CELLS]
    scores = scores[:, keep]
    d_scores = (scores[1 : n + 1] - scores[n + 1 :]).T / (2 * h)
    d_slacks = (slacks[1 : n + 1] - slacks[n + 1 :]).T / (2 * h)
    rows = [
        np.hstack([-d_scores, np.ones((len(d_scores), 1)), np.zeros((len(d_scores), 1))]),
        np.hstack([-d_slacks, np.zeros((len(d_slacks), 1)), -np.ones((len(d_slacks), 1))]),
    ]
    low, high = np.maximum(-radius, -LARGEST - x), np.minimum(radius, LARGEST - x)
    solution = linprog(
        np.append(np.zeros(n), [-1.0, PENALTY]),
        A_ub=np.vstack(rows),
        b_ub=np.concatenate([scores[0], slacks[0]]),
        bounds=[*zip(low, high, strict=True), (None, None), (0.0, None)],
        method="highs",
    )
    return x if solution.x is None else np.asarray(x + solution.x[:n])


def _evaluate(problem: Problem, x: Floats, angles: Floats) -> tuple[Floats, Floats]:
    """Return scores (B, R, m) and slacks less MARGIN (B, c) of unknowns (B, 5); images that are not convex score 0."""
    parameters = parameters_of(x)
    depths = problem.family.depths(parameters)
    convex = np.atleast_1d((depths > 0).all(axis=-1))
    if not convex.all():
        parameters = np.where(convex[:, None], parameters, [0.0, 0.0, 1.0, 0.0, 0.0])
    polygons = centred(problem.family.polygons(parameters))
    scores = np.concatenate(
        [cell_scores(rotated(polygon, angles), problem.rings, problem.mu)[None] for polygon in polygons]
    )
    slacks = np.concatenate([problem.limits.slacks(polygons), depths / SMALLEST_DEPTH - 1.0], axis=-1)
    return np.where(convex[:, None, None], scores, 0.0), slacks - MARGIN


def _merit(scores: Floats, slacks: Floats) -> Floats:
    return np.asarray(scores.min(axis=(1, 2)) + PENALTY * np.minimum(slacks.min(axis=-1), 0.0))


def parameters_of(x: Floats) -> Floats:
    """Turn (N, 5) unknowns of the solver into (N, 5) parameters of the family."""
    return np.column_stack([x[:, 0], x[:, 1], np.exp(x[:, 2]), x[:, 3:]])


def unknowns_of(parameters: Floats) -> Floats:
    """Turn (5,) parameters into the (5,) unknowns that the solver moves: theta, k, log lambda, v1, v2."""
    unknowns = np.array(parameters, dtype=float)
    unknowns[2] = np.log(unknowns[2])
    return unknowns
