"""What a solved graph says: values, covariances, and what it could not determine, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.errors import InputError, UnobservableError
from optshape_graph.graph.chain import Chain, Chains, State
from optshape_graph.graph.linear import LinearSystem
from optshape_graph.graph.terms import Model

MOVES = 1e-3
"""Part of a direction's largest component, above which a variable counts as moving with it."""


@dataclass(frozen=True, eq=False, repr=False)
class UnobservableDirection(Value):
    """A motion of the variables that no measurement resists.

    Attributes:
        text: the motion, in words.
        motion: (6,) tangent vector of each pose that moves, by the variable's name; rotation (rad) first, then metres.
            Of other variables as many components as they have.
    """

    text: str
    motion: Mapping[str, Floats]

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False, repr=False)
class Solution(Value):
    """A solved graph.

    Attributes:
        state: of all variables.
        models: of the terms, there, in their order.
        factors: the other factors.
        error: half the chi-square of all terms and factors, exact, robust losses applied.
        converged: whether a further step would gain nothing.
        iterations: steps taken.
        names: of variables, by key, for messages.
    """

    state: State
    models: Sequence[Model]
    factors: gtsam.NonlinearFactorGraph
    error: float
    converged: bool
    iterations: int
    names: Mapping[int, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        unknowns, state = self.system.A.shape[1], "converged" if self.converged else "not converged"
        return f"Solution({unknowns} unknowns, chi2 {2 * self.error:.4g}, {state} after {self.iterations} steps)"

    def __getstate__(self) -> dict[str, object]:
        """Return what a pickle holds: factors that are callbacks do not pickle, so it is the linearised graph."""
        return {**self.__dict__, "system": self.system, "factors": gtsam.NonlinearFactorGraph(), "models": ()}

    @property
    def values(self) -> gtsam.Values:
        """Values of all variables."""
        return self.state.values

    @cached_property
    def system(self) -> LinearSystem:
        """The graph as matrices, linearised at the solution.

        Raises:
            EstimationError: a factor is not finite there.
        """
        return LinearSystem.of(linearised(self.models, self.factors, self.state), self.values)

    @cached_property
    def unobservable(self) -> tuple[UnobservableDirection, ...]:
        """Directions that the graph does not determine; empty when all is well."""
        return tuple(self._described(direction) for direction in self.system.unobservable.T)

    def pose(self, key: int) -> Floats:
        """Return the estimate (4, 4) of a pose."""
        return np.asarray(self.values.atPose3(key).matrix())

    def covariance(self, keys: Sequence[int]) -> Floats:
        """Return the joint covariance (d, d) of variables, in their order.

        Of a pose it is that of the right perturbation, rotation (rad) first, then metres.

        Raises:
            InputError: no such variable.
            UnobservableError: one of them moves in a direction that is not observable.
        """
        for key in keys:
            if key not in self.system.columns:
                raise InputError(f"variable {gtsam.DefaultKeyFormatter(key)} is not in the graph")
        null = self.system.unobservable
        moving = [k for k in range(null.shape[1]) if any(_moves(null[:, k], self.system.columns[key]) for key in keys)]
        if moving:
            texts = tuple(self.unobservable[k].text for k in moving)
            raise UnobservableError(f"no covariance, since not observable: {'; '.join(texts)}", texts)
        return self.system.covariance(keys)

    def size(self, key: int) -> int:
        """Return the number of degrees of freedom of a variable."""
        columns = self.system.columns[key]
        return int(columns.stop - columns.start)

    def relative(self, chain: Chain) -> tuple[Floats, Floats]:
        """Return a pose made of known ones and variables (4, 4), and the covariance (6, 6) of its right perturbation.

        Args:
            chain: its parts, as of a measurement: `[Inverse(k_lidar), k_target]` is T_lidar_target.

        Raises:
            InputError: no such variable.
            UnobservableError: it moves in a direction that is not observable.
        """
        chains = Chains([chain])
        J = np.hstack([np.zeros((6, 0)), *chains.derivatives(np.eye(6)[None], self.state)[0]])
        covariance = self.covariance(chains.keys[0]) if J.size else np.zeros((0, 0))
        return chains.at(self.state)[0], J @ covariance @ J.T

    def _described(self, direction: Floats) -> UnobservableDirection:
        motion = {
            self.names.get(key, gtsam.DefaultKeyFormatter(key)): direction[columns]
            for key, columns in self.system.columns.items()
            if _moves(direction, columns)
        }
        first = max(motion, key=lambda name: float(np.abs(motion[name]).max()))
        others = [name for name in motion if name != first]
        text = f"{first}: {_in_words(motion[first])}"
        if others:
            text += f", moving {', '.join(others[:3])}{f' and {len(others) - 3} more' if len(others) > 3 else ''} along"
        return UnobservableDirection(text, motion)


def linearised(models: Sequence[Model], factors: gtsam.NonlinearFactorGraph, state: State) -> gtsam.GaussianFactorGraph:
    """Return the linear graph of models and factors at a state."""
    linear = factors.linearize(state.values)
    for model in models:
        model.add_to(linear)
    return linear


def _moves(direction: Floats, columns: slice) -> bool:
    return bool(np.abs(direction[columns]).max(initial=0.0) > MOVES * np.abs(direction).max())


def _in_words(xi: Floats) -> str:
    if len(xi) != 6:
        return f"along {_axis(xi)}"
    rotation, translation = xi[:3], xi[3:]
    if np.linalg.norm(rotation) <= 0.01 * np.linalg.norm(translation):
        return f"translation along {_axis(translation)}"
    return f"rotation about {_axis(rotation)}"


def _axis(v: Floats) -> str:
    unit = v / np.linalg.norm(v)
    return f"[{', '.join(f'{x + 0.0:.2f}' for x in unit.round(2))}]"
