"""Chains: a relative pose as a product of known transforms and variables, and how it moves with each of them.

H = S_1 S_2 ... S_p, each S_j a known transform, a variable X, or the inverse of one. With Q_j = S_j+1 ... S_p, a right
perturbation xi of the variable moves H by Ad(Q_j^-1) xi, and where it stands inverted by -Ad((S_j Q_j)^-1) xi.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.se3 import PoseLike, adjoint, as_transform, inverse


class Inverse(NamedTuple):
    """The inverse of a pose variable, as part of a chain: T_b_a, where the variable is T_a_b.

    Attributes:
        key: of the variable.
    """

    key: int


Step: TypeAlias = PoseLike | int | Inverse
"""Part of a chain: a known transform (4, 4), the key of a pose variable, or its inverse."""

Chain: TypeAlias = Sequence[Step]
"""T_a_d = T_a_b T_b_c T_c_d as its parts, from left to right."""


@dataclass(frozen=True, eq=False, repr=False)
class State(Value):
    """Values of all variables, with the poses among them as one array.

    Attributes:
        values: of the variables.
        pose_keys: (n,) keys of the poses, ascending.
    """

    values: gtsam.Values
    pose_keys: Ints

    @classmethod
    def of(cls, values: gtsam.Values) -> State:
        """Return the state of some values."""
        return cls(values, np.array(gtsam.utilities.allPose3s(values).keys(), np.int64))

    def retract(self, step: gtsam.VectorValues) -> State:
        """Return the state after a step of the variables' tangent vectors."""
        return State(self.values.retract(step), self.pose_keys)

    def poses(self, keys: Ints) -> Floats:
        """Return the poses (..., 4, 4) of variables (...)."""
        return np.asarray(self._poses[np.searchsorted(self.pose_keys, keys)])

    @cached_property
    def _poses(self) -> Floats:
        rows = gtsam.utilities.extractPose3(self.values)  # in the order of their keys
        T = np.zeros((len(rows), 4, 4))
        T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:], 1.0
        return T


@dataclass(frozen=True, eq=False, repr=False)
class _Alike(Value):
    """Chains with the same kinds of parts in the same order: K known, X a variable, I an inverted one.

    Attributes:
        rows: (m,) their numbers.
        kinds: of each part.
        keys: for each part the variables (m,), or none.
        known: for each part the transforms (m, 4, 4), or none.
    """

    rows: Ints
    kinds: str
    keys: list[Ints]
    known: list[Floats]


class Chains:
    """Several chains, evaluated together as arrays.

    Args:
        chains: the parts of each.
    """

    def __init__(self, chains: Sequence[Chain] = ()) -> None:
        merged = [_merged(chain) for chain in chains]
        by_kinds: dict[str, list[int]] = defaultdict(list)
        for n, parts in enumerate(merged):
            by_kinds["".join(kind for kind, _ in parts)].append(n)
        self._alike = []
        for kinds, rows in by_kinds.items():
            columns = [[merged[n][j][1] for n in rows] for j in range(len(kinds))]
            keys = [np.array(c if k != "K" else [], np.int64) for k, c in zip(kinds, columns, strict=True)]
            known = [np.array(c if k == "K" else [], float) for k, c in zip(kinds, columns, strict=True)]
            self._alike.append(_Alike(np.array(rows), kinds, keys, known))

    @classmethod
    def between(cls, first: Ints, second: Ints) -> Chains:
        """Return the chains X_a^-1 X_b of pairs of variables, a of `first` (m,) and b of `second` (m,): keys."""
        chains, nothing = cls(), np.zeros(0)
        if len(first):
            chains._alike = [_Alike(np.arange(len(first)), "IX", [first, second], [nothing, nothing])]
        return chains

    @cached_property
    def keys(self) -> list[list[int]]:
        """The variables of each chain, in the order of their parts."""
        found: list[list[int]] = [[] for _ in range(len(self))]
        for alike in self._alike:
            columns = [own.tolist() for own, kind in zip(alike.keys, alike.kinds, strict=True) if kind != "K"]
            for n, keys in zip(alike.rows.tolist(), zip(*columns, strict=True), strict=bool(columns)):
                found[n] = list(keys)
        return found

    def __len__(self) -> int:
        return sum(len(alike.rows) for alike in self._alike)

    def at(self, state: State) -> Floats:
        """Return the poses (m, 4, 4) of all chains."""
        H = np.empty((len(self), 4, 4))
        for alike in self._alike:
            product = np.broadcast_to(np.eye(4), (len(alike.rows), 4, 4))
            for S in _parts(alike, state):
                product = product @ S
            H[alike.rows] = product
        return H

    def derivatives(self, R: Floats, state: State) -> list[list[Floats]]:
        """Return the rows R (n, 6) times the derivative of each chain by each of its variables, in the order of `keys`.

        Args:
            R: (m, n, 6) by the right perturbation of each chain's pose.
            state: where.
        """
        found: list[list[Floats]] = [[] for _ in self.keys]
        for rows, _, columns in self.blocks(R, state):
            for n, blocks in zip(rows.tolist(), zip(*columns, strict=True), strict=False):
                found[n] = list(blocks)
        return found

    def blocks(self, R: Floats, state: State) -> Iterator[tuple[Ints, list[Ints], list[Floats]]]:
        """Yield the same by kinds of chains: numbers (k,) of the chains, keys and blocks (k, n, 6) of each variable."""
        for alike in self._alike:
            own, columns = R[alike.rows], []
            behind: Floats | None = None  # Q_j; None: the identity
            for kind, S in reversed(list(zip(alike.kinds, _parts(alike, state), strict=True))):
                ahead = S if behind is None else S @ behind
                if kind == "X":
                    columns.append(own if behind is None else own @ adjoint(inverse(behind)))
                elif kind == "I":
                    columns.append(-own @ adjoint(inverse(ahead)))
                behind = ahead
            keys = [keys for kind, keys in zip(alike.kinds, alike.keys, strict=True) if kind != "K"]
            yield alike.rows, keys, columns[::-1]


def _parts(alike: _Alike, state: State) -> list[Floats]:
    return [
        T if kind == "K" else state.poses(keys) if kind == "X" else inverse(state.poses(keys))
        for kind, keys, T in zip(alike.kinds, alike.keys, alike.known, strict=True)
    ]


def _merged(chain: Chain) -> list[tuple[str, int | Floats]]:
    """The parts of a chain with their kinds, known transforms beside each other multiplied, identities left out."""
    parts: list[tuple[str, int | Floats]] = []
    for step in chain:
        if isinstance(step, Inverse):
            parts.append(("I", step.key))
        elif isinstance(step, int):
            parts.append(("X", step))
        else:
            T = as_transform(step, "known part of a chain")
            if np.array_equal(T, np.eye(4)):
                continue
            if parts and parts[-1][0] == "K":
                T = parts.pop()[1] @ T
            parts.append(("K", T))
    return parts
