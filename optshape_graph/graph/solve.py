"""Solve a target graph, and judge the solution by the exact gradient there."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np

from optshape_graph.errors import EstimationError, InputError
from optshape_graph.graph.linear import LinearSystem
from optshape_graph.graph.problem import TargetGraph
from optshape_graph.graph.solution import Solution, describe_unobservable

MAX_ITERATIONS = 30
"""How often the summaries are made again at most."""

ENOUGH = 1e-8
"""Decrease of the cost, in units of half a chi-square, below which an iteration gained nothing."""

MOST_HALVINGS = 12
"""How often a step that raises the exact cost is halved before it is given up."""

ROUNDING = 1e-12
"""Relative rise of the cost that is rounding."""

CONVERGED = 1e-6
"""Newton decrement up to which a solution counts as converged: about a thousandth of a standard deviation."""


def solve(
    graph: TargetGraph,
    other_factors: gtsam.NonlinearFactorGraph | None = None,
    other_values: gtsam.Values | None = None,
) -> Solution:
    """Solve for all unknown poses: Levenberg-Marquardt on summaries, made again until they gain nothing.

    Neither is trusted to have converged: the solution is judged by the exact gradient there.

    Args:
        graph: LiDAR and target poses with their measurements.
        other_factors: what else there is (priors, odometry, markers), on the graph's keys and others.
        other_values: initial values of variables that only the other factors have.

    Raises:
        EstimationError: a factor is not finite.
        InputError: nothing is unknown, a variable of the other factors has no initial value, or one of them is a hard
            constraint, of which there is no information matrix.
    """
    others = gtsam.NonlinearFactorGraph() if other_factors is None else other_factors
    values = graph.initial_values()
    if other_values is not None:
        values.insert(other_values)
    _check(others, values)

    def cost(at: gtsam.Values) -> float:
        return graph.error(at) + others.error(at)

    factors = _joined(graph.factors(values), others)
    error, gain, iterations = cost(values), np.inf, 0
    if not np.isfinite(error):
        raise EstimationError(f"the cost of the initial values is {error}: a measurement or factor is not finite there")
    while gain > ENOUGH and iterations < MAX_ITERATIONS:
        step = values.localCoordinates(_levenberg_marquardt(factors, values))
        values = _descend(values, step, cost, error)
        factors = _joined(graph.factors(values), others)
        gain, error = error - cost(values), cost(values)
        iterations += 1

    system = LinearSystem.of(factors, values)
    names = {key: f"T_world_lidar[{name}]" for name, key in graph.lidar_keys.items()}
    names |= {key: f"T_world_target[{name}]" for name, key in graph.target_keys.items()}
    lidars, targets = graph.poses(values)
    return Solution(
        T_world_lidar=lidars,
        T_world_target=targets,
        residuals=graph.residuals(values),
        unobservable=describe_unobservable(system, names),
        converged=system.decrement < CONVERGED,
        iterations=iterations,
        error=error,
        values=values,
        lidar_keys=graph.lidar_keys,
        target_keys=graph.target_keys,
        system=system,
    )


def _joined(factors: gtsam.NonlinearFactorGraph, others: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    factors.push_back(others)
    return factors


def _levenberg_marquardt(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(0.1 * ENOUGH)
    # A copy: what the optimiser returns must not outlive it.
    return gtsam.Values(gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize())


def _descend(
    values: gtsam.Values, step: gtsam.VectorValues, cost: Callable[[gtsam.Values], float], error: float
) -> gtsam.Values:
    """Take the step, halved until the exact cost does not rise; none if it always does."""
    for _ in range(MOST_HALVINGS):
        moved = values.retract(step)
        if cost(moved) <= error * (1 + ROUNDING):
            return moved
        step = step.scale(0.5)
    return values


def _check(others: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
    if values.size() == 0:
        raise InputError("every pose is known: there is nothing to solve for")
    for factor in (others.at(i) for i in range(others.size())):
        keys = list(factor.keys())
        missing = [key for key in keys if not values.exists(key)]
        if missing:
            raise InputError(f"no initial value for variable {gtsam.DefaultKeyFormatter(missing[0])}")
        noise = factor.noiseModel() if isinstance(factor, gtsam.NoiseModelFactor) else None
        if noise is not None and noise.isConstrained():
            names = ", ".join(gtsam.DefaultKeyFormatter(key) for key in keys)
            raise InputError(f"hard constraint on {names}: give it a small standard deviation instead")
