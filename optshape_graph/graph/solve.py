"""The engine: terms and GTSAM factors, linearised again at every step, and what the solution is worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from optshape_graph.errors import EstimationError, InputError
from optshape_graph.graph.chain import State
from optshape_graph.graph.linear import stacked
from optshape_graph.graph.solution import Solution, linearised
from optshape_graph.graph.terms import Model, Term, add_rows

MAX_ITERATIONS = 50
"""Steps at most."""

CONVERGED = 1e-4
"""Decrease of the cost, in half a chi-square, that is left after the last step: a hundredth of a standard deviation."""

NEAR = 5e-3
"""Decrease of the cost that a step promises, in half a chi-square, with which the solution is there though no step
lowers the cost: a tenth of a standard deviation. A robust loss of measurements that share errors has a gradient that
the linearisation leaves out."""

FASTEST = 0.05
"""Ratio of what a step promises to what the one before did, that is not relied on to go on: Gauss-Newton steps often
shrink far faster, but for robust weights, which follow a step behind."""

ROUNDING = 1e-12
"""Relative rise of the cost that is rounding."""

NEGLIGIBLE = 1e-9
"""Rise of the cost, in half a chi-square, that is none."""

SLIGHT_DAMPING = 1e-3
"""Damping up to which a step goes as far as the measurements ask for, in all directions that they determine."""

LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e6
"""Damping that a step begins with when it is needed, and with which it is given up, relative to the information."""


def solve(
    values: gtsam.Values,
    terms: Sequence[Term] = (),
    factors: gtsam.NonlinearFactorGraph | None = None,
    names: Mapping[int, str] | None = None,
) -> Solution:
    """Minimise the cost of terms and factors: Gauss-Newton on the exact linearisation, damped where it must be.

    Directions that nothing determines stay where they are; the solution says which they are.

    Args:
        values: initial values of all variables.
        terms: parts of the cost that are no GTSAM factors.
        factors: the others: priors, odometry, markers.
        names: of variables, by key, for messages; others go by their symbol.

    Raises:
        EstimationError: the cost of the initial values is not finite.
        InputError: there are no variables, a variable has no initial value, or a factor is a hard constraint, of which
            there is no information matrix.
    """
    others = gtsam.NonlinearFactorGraph() if factors is None else factors
    _check(others, values)
    state = State.of(values)
    models = [term.at(state) for term in terms]
    error, damping, iterations, converged, before = _error(models, others, state), 0.0, 0, False, 0.0
    if not np.isfinite(error):
        raise EstimationError(f"the cost of the initial values is {error}: a measurement or factor is not finite there")
    ordering: gtsam.Ordering | None = None  # what links what stays the same
    while not converged and iterations < MAX_ITERATIONS:
        linear = linearised(models, others, state)
        if ordering is None:
            ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        undamped = np.inf
        while True:
            step = _step(linear, ordering, damping, values.dims())
            if step is not None:
                promised = -0.5 * float(linear.gradientAtZero().dot(step))  # if the graph is linear
                if damping == 0.0:
                    undamped = promised
                moved = state.retract(step)
                lower = [term.at(moved) for term in terms]
                cost = _error(lower, others, moved)
                if cost <= error * (1 + ROUNDING) + NEGLIGIBLE:
                    break
                if damping <= SLIGHT_DAMPING and cost < error + CONVERGED and promised < CONVERGED:
                    return Solution(state, models, others, error, True, iterations, dict(names or {}))  # it is there
            damping = max(LEAST_DAMPING, 10 * damping)
            if damping > MOST_DAMPING or (undamped < NEAR and damping > SLIGHT_DAMPING):
                return Solution(state, models, others, error, undamped < NEAR, iterations, dict(names or {}))
        shrinks = min(max(promised / before, FASTEST), 1.0) if before else 1.0
        converged, before = promised * shrinks < CONVERGED and damping <= SLIGHT_DAMPING, promised
        state, models, error = moved, lower, cost
        damping = damping / 10 if damping > 10 * LEAST_DAMPING else 0.0
        iterations += 1
    return Solution(state, models, others, error, converged, iterations, dict(names or {}))


def _error(models: Sequence[Model], factors: gtsam.NonlinearFactorGraph, state: State) -> float:
    return sum(model.error for model in models) + float(factors.error(state.values))


def _step(
    linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, damping: float, dims: Mapping[int, int]
) -> gtsam.VectorValues | None:
    """The step, with a damping relative to each unknown's information; None if that leaves it singular."""
    if damping:
        rows, columns = stacked(linear, dims)
        information = np.asarray(rows.multiply(rows).sum(axis=0)).ravel()
        linear = linear.clone()
        for key in sorted(set(linear.keyVector())):
            own = information[columns[key]]
            if not len(own):
                continue  # a sensor without shared errors
            root = np.sqrt(damping * np.maximum(own, 1e-6 * max(own.max(), 1.0)))
            add_rows(linear, [key], [np.diag(root)], np.zeros(len(root)))
    try:
        step = linear.optimize(ordering)
    except RuntimeError:
        return None
    return step if np.isfinite(step.norm()) else None


def _check(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
    if values.size() == 0:
        raise InputError("every pose is known: there is nothing to solve for")
    missing = [key for key in factors.keyVector() if not values.exists(key)]
    if missing:
        raise InputError(f"no initial value for variable {gtsam.DefaultKeyFormatter(missing[0])}")
    for factor in (factors.at(i) for i in range(factors.size())):
        noise = factor.noiseModel() if isinstance(factor, gtsam.NoiseModelFactor) else None
        if noise is not None and noise.isConstrained():
            names = ", ".join(gtsam.DefaultKeyFormatter(key) for key in factor.keys())  # noqa: SIM118 - not a mapping
            raise InputError(f"hard constraint on {names}: give it a small standard deviation instead")
