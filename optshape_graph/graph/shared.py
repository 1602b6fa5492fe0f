"""What measurements have in common: errors of a sensor that are variables of the graph, such as its rings' biases.

A measurement's residuals are B beta + A z + r, beta being the shared errors in their standard deviations. Were beta
marginalised in each measurement by itself, it would average away over many, and what is seen often would seem better
known than it is. As a variable it is one for all measurements of a sensor. Linearised at H, the rows reduce to

    [R_xi  R_beta  d; 0  S  s; 0  0  c],

of which the first six link poses and errors, and the others are of the errors alone.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.factors import BiasedMeasurement, SharedError
from optshape_graph.factors._rows import factored, triangular
from optshape_graph.graph.chain import Chain, Chains, State
from optshape_graph.graph.linear import LinearSystem
from optshape_graph.graph.terms import add_rows, huber, huber_weight
from optshape_graph.se3 import vec, vec_derivative

BLOCK = 256
"""Measurements that are linearised at a time: more would only take memory."""


@dataclass(frozen=True, eq=False, repr=False)
class SharedErrors(Value):
    """Measurements of T_target_lidar, with the errors that those of one sensor share as its variable.

    The variable is a vector, in standard deviations of its entries, whose prior is part of the term.

    Attributes:
        chains: of T_target_lidar.
        measurements: (m,) linear in the errors that they share.
        sensor: (m,) which of `keys` each measurement's errors are.
        keys: of the sensors' variables.
        errors: of each sensor, in the order of its variable's entries.
        loss: of Huber, as in `Templates`.
    """

    chains: Chains
    measurements: tuple[BiasedMeasurement, ...]
    sensor: Ints
    keys: tuple[int, ...]
    errors: tuple[tuple[SharedError, ...], ...]
    loss: float = np.inf

    @classmethod
    def of(
        cls,
        measurements: Sequence[BiasedMeasurement],
        chains: Sequence[Chain],
        sensors: Sequence[int],
        loss: float = np.inf,
    ) -> SharedErrors:
        """Return the term of measurements (m,), what T_target_lidar is made of (m,), and the sensors' keys (m,)."""
        keys = tuple(dict.fromkeys(sensors))
        errors: dict[int, dict[SharedError, None]] = {key: {} for key in keys}
        for measurement, key in zip(measurements, sensors, strict=True):
            errors[key].update(dict.fromkeys(measurement.shared))
        sensor = np.array([keys.index(key) for key in sensors], int)
        named = tuple(tuple(found) for found in errors.values())
        return cls(Chains(chains), tuple(measurements), sensor, keys, named, loss)

    def insert(self, values: gtsam.Values) -> None:
        """Add the variables, zero, to initial values."""
        for key, errors in zip(self.keys, self.errors, strict=True):
            values.insert(key, np.zeros(len(errors)))

    def at(self, state: State) -> SharedErrorsModel:
        """Return the Gauss-Newton model of every measurement at a state."""
        H, widest = self.chains.at(state), max(map(len, self.errors), default=0)
        beta = np.zeros((len(self.keys), widest))
        for s, key in enumerate(self.keys):
            beta[s, : len(self.errors[s])] = state.values.atVector(key)
        alone = [np.column_stack([np.eye(widest), b]) for b in beta]  # the prior
        linked = np.zeros((len(H), 6, widest + 7))
        for first in range(0, len(H), BLOCK):
            block = slice(first, first + BLOCK)
            sensor, rows = self.sensor[block], self._rows(block, widest)
            B, A, r = rows[..., :widest], rows[..., widest:-1], rows[..., -1:]
            residual = B @ beta[sensor][..., None] + A @ vec(H[block])[..., None] + r
            R = factored(np.concatenate([A @ vec_derivative(H[block]), B, residual], axis=-1))
            linked[block] = R[:, :6]
            for s in set(sensor.tolist()):
                alone[s] = triangular(np.vstack([alone[s], R[sensor == s, 6:, 6:].reshape(-1, widest + 1)]))
        return SharedErrorsModel(self, state, linked[..., :6], linked[..., 6:-1], linked[..., -1], alone)

    def _rows(self, block: slice, widest: int) -> Floats:
        """(b, n, widest + 13) rows over [beta; z; 1] of some measurements, beta as their sensors have it, padded."""
        some, places = self.measurements[block], self._places[block]
        rows = np.zeros((len(some), max(len(one.stack) for one in some), widest + 13))
        for row, one, place in zip(rows, some, places, strict=True):
            row[: len(one.stack), [*place, *range(widest, widest + 13)]] = one.stack
        return rows

    @cached_property
    def _places(self) -> list[list[int]]:
        """Of each measurement, the entries of its sensor's variable that its errors are."""
        numbers = [{error: k for k, error in enumerate(errors)} for errors in self.errors]
        return [
            [numbers[s][error] for error in one.shared]
            for one, s in zip(self.measurements, self.sensor.tolist(), strict=True)
        ]


@dataclass(frozen=True, eq=False, repr=False)
class SharedErrorsModel(Value):
    """Gauss-Newton models 1/2 ||R xi + E beta + d||^2 of measurements, and what is of the errors alone.

    Attributes:
        term: that this is the model of.
        state: where it is linearised.
        R: (m, 6, 6) by the right perturbation of T_target_lidar, whitened.
        E: (m, 6, k) by the errors, whitened.
        d: (m, 6) whitened.
        alone: of each sensor, (k + 1, k + 1) rows [S s; 0 c] over [beta; 1], the prior among them.
    """

    term: SharedErrors
    state: State
    R: Floats
    E: Floats
    d: Floats
    alone: list[Floats]

    @property
    def chi2(self) -> Floats:
        """(m,) chi-square of each that its own best pose would take away: 6 degrees of freedom."""
        return np.asarray(np.square(self.d).sum(axis=1))

    @property
    def weight(self) -> Floats:
        """(m,) weight that the loss gives each, 0 to 1."""
        return huber_weight(self.chi2, self.term.loss)

    @property
    def error(self) -> float:
        """Half the chi-square, the loss applied to what a pose can take away."""
        alone = sum(float(np.square(rows[:, -1]).sum()) for rows in self.alone)
        return 0.5 * float(huber(self.chi2, self.term.loss).sum()) + 0.5 * alone

    def add_to(self, linear: gtsam.GaussianFactorGraph) -> None:
        """Add the linearisation to a graph."""
        term, root = self.term, np.sqrt(self.weight)
        blocks = term.chains.derivatives(self.R * root[:, None, None], self.state)
        E, d = self.E * root[:, None, None], -self.d * root[:, None]
        for n, (keys, by) in enumerate(zip(term.chains.keys, blocks, strict=True)):
            s = int(term.sensor[n])
            add_rows(linear, [*keys, term.keys[s]], [*by, E[n, :, : len(term.errors[s])]], d[n])
        for key, errors, rows in zip(term.keys, term.errors, self.alone, strict=True):
            add_rows(linear, [key], [rows[:, : len(errors)]], -rows[:, -1])


def gain(
    measurement: BiasedMeasurement, T_target_lidar: Floats, own: Sequence[SharedError], weight: float = 1.0
) -> Floats:
    """Return what errors add to a measurement's information vector where each measurement takes them for its own.

    With B their columns, J those of everything else and W the inverse of I + B B^T, it is J^T W B, times the weight
    that a robust loss gives the measurement.

    Args:
        measurement: linear in the errors.
        T_target_lidar: (4, 4) pose of linearisation.
        own: c of the measurement's errors.
        weight: 0 to 1.

    Returns:
        (6 + s, c) matrix, by the right perturbation of the pose, then by the s other errors in their order.
    """
    k = len(measurement.shared)
    taken = np.array([error in own for error in measurement.shared], bool)
    B, others = measurement.stack[:, :k][:, taken], measurement.stack[:, :k][:, ~taken]
    J = np.hstack([measurement.stack[:, k:-1] @ vec_derivative(T_target_lidar), others])
    return np.asarray(weight * (J.T @ np.linalg.solve(np.eye(len(B)) + B @ B.T, B)))


class Gain(NamedTuple):
    """What one measurement's errors add to the information vector.

    Attributes:
        blocks: by some of the system's unknowns: their numbers, and the gain (n, c) matrix there.
        errors: names (c,) of the errors: what is equal is the same error.
    """

    blocks: Sequence[tuple[Ints, Floats]]
    errors: Sequence[Hashable]


def persistent(system: LinearSystem, keys: Sequence[int], gains: Iterable[Gain]) -> Floats:
    """Return the joint covariance (d, d) of variables, and in it that errors persist which an estimate took for new.

    The estimate is x = P sum_k J_k^T W_k r_k, each measurement's errors taken for its own. With G_k their gain and G
    the sum, x moves by P G beta if all errors are one beta, of which P holds sum_k P G_k G_k^T P. So the covariance is
    P + P G G^T P - sum_k P G_k G_k^T P.

    Args:
        system: of the estimate; P is its covariance.
        keys: of the variables.
        gains: of each measurement.
    """
    moved = system.columns_of_covariance(keys)
    covariance = system.covariance(keys)
    together: dict[Hashable, Floats] = {}
    for blocks, errors in gains:
        by = sum((moved[unknowns].T @ G for unknowns, G in blocks), np.zeros((len(covariance), len(errors))))
        covariance = covariance - by @ by.T
        for error, column in zip(errors, by.T, strict=True):
            together[error] = together[error] + column if error in together else column
    columns = np.array(list(together.values())).reshape(-1, len(covariance))
    return np.asarray(covariance + columns.T @ columns)
