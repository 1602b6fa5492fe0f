"""Placements that took no part judge a calibration: do they become likelier by it?

With their poses free, what their rings say beside is linear in the errors: S beta + s, whitened. Before the calibration
beta has its prior, after it what the other placements say of it. The difference of the logarithms of the two
probabilities is what the calibration is worth there.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.sensor.graph import Joint
from optshape_graph.calibration.sensor.seen import Seen, of_placement
from optshape_graph.calibration.sensor.unknowns import kind_of
from optshape_graph.factors import AZIMUTH, EDGE_OFFSET, ELEVATION, RANGE_BIAS, SharedError
from optshape_graph.factors._rows import triangular
from optshape_graph.se3 import vec, vec_derivative

IN_TURN = (RANGE_BIAS, EDGE_OFFSET, ELEVATION, AZIMUTH)
"""Kinds of errors, in the order in which they are asked whether they help."""

HELPS = 3.0
"""Logarithm by which placements left out become likelier, at least, by a kind of error that is taken over: less, and it
may be by chance."""


def that_help(folds: Sequence[tuple[Joint, Joint]]) -> tuple[tuple[str, ...], dict[int, float]]:
    """Return the kinds of errors by whose calibration placements left out become likelier, and by how much in all.

    Args:
        folds: placements left out, solved by themselves; and the calibration by the others.

    Returns:
        The kinds, and the gain of each placement that was left out, by its number.
    """
    kept: tuple[str, ...] = ()
    best: dict[int, float] = {}
    for kind in IN_TURN:
        found = {p: gain for held, trained in folds for p, gain in gains(held, trained, (*kept, kind)).items()}
        if sum(found.values()) - sum(best.values()) > HELPS:
            kept, best = (*kept, kind), found
    return kept, best


def gains(held: Joint, trained: Joint, kinds: Collection[str]) -> dict[int, float]:
    """Return by how much each placement becomes likelier, logarithm, by its number.

    Args:
        held: these placements, solved by themselves.
        trained: the calibration by all others.
        kinds: of errors of the sensor that are taken over from it; others keep their prior.
    """
    by_placement: dict[int, list[Seen]] = {}
    for one in held.seen:
        by_placement.setdefault(one.placement, []).append(one)
    found = {}
    for placement, seen in by_placement.items():
        rows, errors = about_errors(seen, held.T_target_lidar[placement])
        mean, covariance = posterior_of(trained, errors, kinds)
        before = _log_density(rows, np.zeros(len(errors)), np.eye(len(errors)))
        found[placement] = _log_density(rows, mean, covariance) - before
    return found


def about_errors(seen: Sequence[Seen], T_target_lidar: Floats) -> tuple[Floats, tuple[SharedError, ...]]:
    """Return what revolutions of a placement say of k errors, its pose free: whitened rows (m, k + 1), and the errors.

    Args:
        seen: its revolutions.
        T_target_lidar: (4, 4) its pose.
    """
    total = of_placement(seen, T_target_lidar)
    k = len(total.shared)
    B, A, r = total.stack[:, :k], total.stack[:, k:-1], total.stack[:, -1]
    rows = np.column_stack([A @ vec_derivative(T_target_lidar), B, A @ vec(T_target_lidar) + r])
    return triangular(rows)[6 : 6 + k + 1, 6:], total.shared


def posterior_of(joint: Joint, errors: Sequence[SharedError], kinds: Collection[str]) -> tuple[Floats, Floats]:
    """Return mean (k,) and covariance (k, k) of errors of some kinds by a solution, in prior standard deviations.

    What all rings share of a kind goes with it. Others keep their prior.

    Args:
        joint: the solution.
        errors: k of them.
        kinds: of errors that are taken from it.
    """
    place: Mapping[SharedError, int] = {error: i for i, error in enumerate(joint.errors)}
    known = np.array([k for k, error in enumerate(errors) if error in place and kind_of(error) in kinds], int)
    there = np.array([place[errors[k]] for k in known], int)
    mean, covariance = np.zeros(len(errors)), np.eye(len(errors))
    mean[known] = joint.beta[there]
    covariance[np.ix_(known, known)] = joint.covariance[np.ix_(there, there)]
    return mean, covariance


def _log_density(rows: Floats, mean: Floats, covariance: Floats) -> float:
    S, s = rows[:, :-1], rows[:, -1]
    e = S @ mean + s
    total = np.eye(len(S)) + S @ covariance @ S.T
    return -0.5 * float(e @ np.linalg.solve(total, e) + np.linalg.slogdet(total)[1])
