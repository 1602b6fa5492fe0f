"""Terms: parts of a cost that are evaluated as arrays, many measurements at a time, beside GTSAM's own factors.

A term is asked for its model at a state, and never changes; the model knows its exact error there and its Gauss-Newton
linearisation, which are the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.factors import TemplateMeasurement
from optshape_graph.factors._rows import factored
from optshape_graph.graph.chain import Chain, Chains, State
from optshape_graph.se3 import difference, inverse_right_jacobian, vec, vec_derivative

ILL_CONDITIONED = 1e-5
"""Ratio of the least to the largest entry of a Cholesky factor's diagonal, below which QR is used instead: squaring the
rows has lost half of the digits."""

RIDGE = 1e-13
"""Added to what is factored by Cholesky, relative to its trace: a measurement may leave a direction open."""


_JACOBIAN_FACTOR: Any = gtsam.JacobianFactor
"""Its overloads take pairs of a key and a block, which is no type that a list has."""


class Model(Protocol):
    """A term at one state."""

    @property
    def error(self) -> float:
        """Half the chi-square, exact."""

    def add_to(self, linear: gtsam.GaussianFactorGraph) -> None:
        """Add the linearisation to a graph."""


class Term(Protocol):
    """Part of a cost."""

    def at(self, state: State) -> Model:
        """Return the term's model at a state."""


@dataclass(frozen=True, eq=False, repr=False)
class Templates(Value):
    """Template measurements of T_target_lidar, each a chain of known poses and variables.

    Attributes:
        chains: of T_target_lidar.
        L: (m, 12, 12) of the measurements, whitened.
        b: (m, 12) whitened.
        constant: (m,) chi-square of each that no pose takes away.
        loss: Huber's loss turns from squares to lines at this many standard deviations of a measurement's own best
            pose; infinite: least squares.
    """

    chains: Chains
    L: Floats
    b: Floats
    constant: Floats
    loss: float = np.inf

    @classmethod
    def of(
        cls, measurements: Sequence[TemplateMeasurement], chains: Chains | Sequence[Chain], loss: float = np.inf
    ) -> Templates:
        """Return the term of measurements (m,) of T_target_lidar, and what that is made of (m,)."""
        return cls(
            chains if isinstance(chains, Chains) else Chains(chains),
            np.array([m.L for m in measurements]).reshape(-1, 12, 12),
            np.array([m.b for m in measurements]).reshape(-1, 12),
            np.array([m.c**2 for m in measurements]),
            loss,
        )

    def at(self, state: State) -> TemplatesModel:
        """Return the Gauss-Newton model of every measurement at a state."""
        H = self.chains.at(state)
        rows = self.L @ np.concatenate([vec_derivative(H), vec(H)[..., None]], axis=2)
        rows[..., 6] += self.b
        R = _triangular(rows)
        return TemplatesModel(
            self.chains, state, R[:, :6, :6], R[:, :6, 6], np.square(R[:, 6, 6]) + self.constant, self.loss
        )


@dataclass(frozen=True, eq=False, repr=False)
class TemplatesModel(Value):
    """Gauss-Newton models 1/2 ||R xi + d||^2 + 1/2 floor of m measurements, xi the right perturbation of each pose.

    Attributes:
        chains: of T_target_lidar.
        state: where they are linearised.
        R: (m, 6, 6) upper triangular, whitened.
        d: (m, 6) whitened.
        floor: (m,) chi-square that no pose takes away, to first order.
        loss: of Huber, in standard deviations.
    """

    chains: Chains
    state: State
    R: Floats
    d: Floats
    floor: Floats
    loss: float

    @property
    def chi2(self) -> Floats:
        """(m,) chi-square of each that its own best pose would take away: 6 degrees of freedom."""
        return np.asarray(np.square(self.d).sum(axis=1))

    @property
    def weight(self) -> Floats:
        """(m,) weight that the loss gives each, 0 to 1."""
        return huber_weight(self.chi2, self.loss)

    @property
    def error(self) -> float:
        """Half the chi-square, exact, the loss applied to what a pose can take away."""
        return 0.5 * float((huber(self.chi2, self.loss) + self.floor).sum())

    def add_to(self, linear: gtsam.GaussianFactorGraph) -> None:
        """Add the linearisation to a graph."""
        root = np.sqrt(self.weight)
        unit, right = _unit(6), -self.d * root[:, None]
        for rows, keys, blocks in self.chains.blocks(self.R * root[:, None, None], self.state):
            if len(keys) == 2 and not (keys[0] == keys[1]).any():  # nearly all: a sensor and a target
                one, other = (own.tolist() for own in keys)
                for i, A, j, B, d in zip(one, blocks[0], other, blocks[1], right[rows], strict=True):
                    linear.add(i, A, j, B, d, unit)
            else:
                for n, *by in zip(rows.tolist(), *blocks, strict=True):
                    add_rows(linear, self.chains.keys[n], by, right[n])


@dataclass(frozen=True, eq=False, repr=False)
class JointPoses(Value):
    """A joint Gaussian measurement of poses, each a chain: Log(M_i^-1 H_i) of all i together, whitened.

    Attributes:
        chains: of the poses H_i.
        measured: (m, 4, 4) M_i.
        sqrt_information: (6 m, 6 m) matrix R: R^T R is the inverse of the joint covariance of right perturbations.
    """

    chains: Chains
    measured: Floats
    sqrt_information: Floats

    def at(self, state: State) -> JointPosesModel:
        """Return the residual and its derivatives at a state."""
        xi = difference(self.measured, self.chains.at(state))
        by = self.chains.derivatives(inverse_right_jacobian(xi), state)
        return JointPosesModel(self.chains.keys, by, xi.ravel(), self.sqrt_information)


@dataclass(frozen=True, eq=False, repr=False)
class JointPosesModel(Value):
    """A joint measurement of poses at one state.

    Attributes:
        keys: of each pose's variables.
        by: derivatives (6, 6) of each pose's residual by them.
        residual: (6 m,) tangent vectors, rad and metres.
        sqrt_information: (6 m, 6 m) matrix, that whitens it.
    """

    keys: list[list[int]]
    by: list[list[Floats]]
    residual: Floats
    sqrt_information: Floats

    @property
    def error(self) -> float:
        """Half the chi-square."""
        return 0.5 * float(np.square(self.sqrt_information @ self.residual).sum())

    def add_to(self, linear: gtsam.GaussianFactorGraph) -> None:
        """Add the linearisation to a graph."""
        columns: dict[int, Floats] = {}
        for i, (keys, blocks) in enumerate(zip(self.keys, self.by, strict=True)):
            for key, block in zip(keys, blocks, strict=True):
                part = self.sqrt_information[:, 6 * i : 6 * i + 6] @ block
                columns[key] = columns[key] + part if key in columns else part
        add_rows(linear, list(columns), list(columns.values()), -self.sqrt_information @ self.residual)


def huber(chi2: Floats, loss: float) -> Floats:
    """Return twice Huber's cost (m,) of chi-squares (m,): quadratic up to the loss, then a line."""
    if np.isinf(loss):
        return chi2
    return np.asarray(np.where(chi2 > loss**2, 2 * loss * np.sqrt(chi2) - loss**2, chi2))


def huber_weight(chi2: Floats, loss: float) -> Floats:
    """Return the weight (m,), 0 to 1, that Huber's loss gives residuals of chi-squares (m,)."""
    return np.asarray(np.minimum(1.0, loss / np.sqrt(np.maximum(chi2, 1e-12))))


def add_rows(linear: gtsam.GaussianFactorGraph, keys: Sequence[int], blocks: Sequence[Floats], b: Floats) -> None:
    """Add 1/2 ||sum A_k x_k - b||^2 to a linear graph; a variable may come more than once.

    Args:
        linear: to add to.
        keys: of the variables.
        blocks: (n, d_k) A_k, whitened.
        b: (n,) whitened.
    """
    if len(set(keys)) < len(keys):
        summed: dict[int, Floats] = {}
        for key, block in zip(keys, blocks, strict=True):
            summed[key] = summed[key] + block if key in summed else block
        keys, blocks = list(summed), list(summed.values())
    if not keys:
        return
    if len(keys) <= 3:  # as many as GTSAM's constructors take from Python
        pairs = [part for pair in zip(keys, blocks, strict=True) for part in pair]
        linear.push_back(_JACOBIAN_FACTOR(*pairs, b, _unit(len(b))))
        return
    # Pairs of variables are what its Hessian takes; added up they are one factor of all of them.
    quadratic = gtsam.GaussianFactorGraph()
    for i, (key, A) in enumerate(zip(keys, blocks, strict=True)):
        quadratic.push_back(gtsam.HessianFactor(key, A.T @ A, A.T @ b, float(b @ b) if i == 0 else 0.0))
        for other, B in zip(keys[i + 1 :], blocks[i + 1 :], strict=True):
            G, H = np.zeros((A.shape[1], A.shape[1])), np.zeros((B.shape[1], B.shape[1]))
            quadratic.push_back(gtsam.HessianFactor(key, other, G, A.T @ B, np.zeros(len(G)), H, np.zeros(len(H)), 0.0))
    linear.push_back(gtsam.HessianFactor(quadratic))


@cache
def _unit(n: int) -> gtsam.noiseModel.Unit:
    return gtsam.noiseModel.Unit.Create(n)


def _triangular(rows: Floats) -> Floats:
    """The triangular factors (m, 7, 7) of rows (m, 12, 7): by Cholesky, twice as fast as QR, where that is as good."""
    G = np.swapaxes(rows, 1, 2) @ rows
    tiny = np.finfo(float).tiny + RIDGE * np.trace(G, axis1=1, axis2=2)
    G[:, range(7), range(7)] += tiny[:, None]
    R = np.swapaxes(np.linalg.cholesky(G), 1, 2).copy()
    diagonal = R[:, range(6), range(6)]
    ill = ~(diagonal.min(axis=1) > ILL_CONDITIONED * diagonal.max(axis=1))
    if ill.any():
        R[ill] = factored(rows[ill])
    R[~ill, 6, 6] = np.sqrt(np.maximum(np.square(R[~ill, 6, 6]) - tiny[~ill], 0.0))
    return R
