"""The graph of a sensor's calibration: poses of boards, and the errors that all revolutions share.

H_p   T_target_lidar of placement p
B     all shared errors, in prior standard deviations

The engine solves for both; the Gaussians that ring ends stand for are then made again in the company of the solution,
and so on until neither changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, H

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.sensor.seen import Seen, of_placement
from optshape_graph.errors import EstimationError
from optshape_graph.factors import SharedError
from optshape_graph.graph import SharedErrors
from optshape_graph.graph import solve as minimise
from optshape_graph.pose.ends import DAMPING

ROUNDS = 30
"""Turns at most."""

MOVING = 6
"""Turns in which a ring may come to leave by another edge, and an end to count for nothing: they could go on to change
their minds."""

SWINGING = 10
"""Turns after which Gaussians that still change swing about where they belong, and go half as far."""

LOOSE = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
"""Of a pose about where it starts, rad and metres: rings that end on two parallel sides alone leave it open."""

SETTLED = 0.03
"""Change of every shared error, in its standard deviations, below which another turn changes nothing."""


@dataclass(frozen=True, eq=False, repr=False)
class Known(Value):
    """What is known beside the returns: factors on the placements' poses and on variables of their own.

    Attributes:
        factors: of the keys H(p) and of others.
        values: of the others, to start from.
    """

    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values

    @classmethod
    def nothing(cls) -> Known:
        """Return that nothing is."""
        return cls(gtsam.NonlinearFactorGraph(), gtsam.Values())


@dataclass(frozen=True, eq=False, repr=False)
class Joint(Value):
    """The solution.

    Attributes:
        T_target_lidar: (4, 4) of each placement.
        errors: (k,) the shared errors.
        beta: (k,) they, in prior standard deviations.
        covariance: (k, k) of them, in those standard deviations squared.
        seen: everything that was seen, with its Gaussians.
        rounds: turns taken.
        settled: whether more would change nothing.
    """

    T_target_lidar: Mapping[int, Floats]
    errors: tuple[SharedError, ...]
    beta: Floats
    covariance: Floats
    seen: tuple[Seen, ...]
    rounds: int
    settled: bool


def solve(seen: Sequence[Seen], start: Mapping[int, Floats], known: Known | None = None) -> Joint:
    """Solve for all poses and shared errors.

    Args:
        seen: the boards in all revolutions.
        start: (4, 4) T_target_lidar of each placement to start from.
        known: what is known beside the returns.

    Raises:
        EstimationError: the solution is not found.
    """
    known = Known.nothing() if known is None else known
    poses = dict(start)
    beta, settled = np.zeros(0), False
    for turn in range(1, ROUNDS + 1):
        term = SharedErrors.of(
            [of_placement([one for one in seen if one.placement == p], poses[p]) for p in poses],
            [[H(p)] for p in poses],
            [B(0)] * len(poses),
        )
        values = gtsam.Values()
        values.insert(known.values)
        factors = gtsam.NonlinearFactorGraph(known.factors)
        for p, T in poses.items():
            values.insert(H(p), gtsam.Pose3(T))
            factors.push_back(gtsam.PriorFactorPose3(H(p), gtsam.Pose3(start[p]), LOOSE))
        errors = term.errors[0]
        before = beta if turn > 1 else np.zeros(len(errors))
        values.insert(B(0), before)
        solution = minimise(values, [term], factors)
        if not np.isfinite(solution.error):
            raise EstimationError("the calibration graph has no finite minimum")
        poses = {p: solution.pose(H(p)) for p in poses}
        beta = np.asarray(solution.values.atVector(B(0)))
        system = solution.system
        everything = np.asarray(np.linalg.inv(system.information.toarray()), dtype=float)
        own = system.index([B(0)])
        place = {error: k for k, error in enumerate(errors)}
        covariance = everything[np.ix_(own, own)]
        step = np.abs(beta - before) / np.sqrt(np.diag(covariance))
        settled = turn > 3 and bool(step.max() < SETTLED)
        if settled:
            break
        undecided = turn < MOVING
        go = DAMPING if undecided else DAMPING / 2 if turn < SWINGING else DAMPING / 4
        again = []
        for one in seen:
            index = np.concatenate([system.index([H(one.placement)]), own])
            where = np.array([place[error] for error in one.rows(poses[one.placement]).errors])
            again.append(
                one.updated(poses[one.placement], where, beta, everything[np.ix_(index, index)], undecided, go)
            )
        seen = again
    return Joint(poses, errors, beta, covariance, tuple(seen), turn, settled)
