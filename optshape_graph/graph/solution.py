"""What a solved graph says: poses, covariances, residuals, and what it could not determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError, UnobservableError
from optshape_graph.graph.linear import LinearSystem
from optshape_graph.se3 import adjoint, inverse

MOVES = 1e-3
"""Part of a direction's largest component from which on a variable counts as moving with it."""


@dataclass(frozen=True)
class Residual:
    """How well one measurement fits the solution.

    Attributes:
        scan: whose LiDAR pose.
        target: which target.
        chi2: sum of the squared whitened residuals of all its points.
        n_rows: number of those residuals.
        chi2_pose: what of it the measurement's own best pose would take away: 6 degrees of freedom. It is large where
            measurements contradict each other.
    """

    scan: str
    target: str
    chi2: float
    n_rows: int
    chi2_pose: float


@dataclass(frozen=True, eq=False)
class UnobservableDirection:
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


@dataclass(frozen=True, eq=False)
class Solution:
    """A solved graph.

    Attributes:
        T_world_lidar: (4, 4) of every scan, known or estimated.
        T_world_target: (4, 4) of every target, known or estimated.
        residuals: one for each observation, in their order.
        unobservable: directions that the graph does not determine; empty when all is well.
        converged: whether a Gauss-Newton step from here would gain nothing.
        iterations: how often the summaries were made.
        error: half the chi-square of all measurements and other factors, exact.
        values: all variables, those of other factors included.
        lidar_keys: key of each estimated LiDAR pose.
        target_keys: key of each estimated target pose.
        system: the graph, linearised at the solution.
    """

    T_world_lidar: Mapping[str, Floats]
    T_world_target: Mapping[str, Floats]
    residuals: tuple[Residual, ...]
    unobservable: tuple[UnobservableDirection, ...]
    converged: bool
    iterations: int
    error: float
    values: gtsam.Values
    lidar_keys: Mapping[str, int]
    target_keys: Mapping[str, int]
    system: LinearSystem

    def covariance(self, scans: Sequence[str] = (), targets: Sequence[str] = (), keys: Sequence[int] = ()) -> Floats:
        """Return the joint covariance (d, d) of poses and other variables, in the order of the arguments.

        Poses take six rows each, the right perturbation of T_world_lidar or T_world_target, rotation first; those of
        known poses are zero.

        Args:
            scans: of whose T_world_lidar.
            targets: of whose T_world_target.
            keys: of other variables.

        Raises:
            InputError: no such scan, target or variable.
            UnobservableError: one of them moves in a direction that is not observable.
        """
        wanted: list[int | None] = []
        for names, poses, known in (
            (scans, self.T_world_lidar, self.lidar_keys),
            (targets, self.T_world_target, self.target_keys),
        ):
            for name in names:
                if name not in poses:
                    raise InputError(f"'{name}' is not in the graph; it holds {', '.join(sorted(poses))}")
                wanted.append(known.get(name))
        for key in keys:
            if key not in self.system.columns:
                raise InputError(f"variable {gtsam.DefaultKeyFormatter(key)} is not in the graph")
            wanted.append(key)
        sizes = [6 if key is None else _size(self.system.columns[key]) for key in wanted]
        estimated = [key for key in wanted if key is not None]
        self._require_observable(estimated)
        joint = np.zeros((sum(sizes), sum(sizes)))
        if estimated:
            free = np.repeat([key is not None for key in wanted], sizes)
            joint[np.ix_(free, free)] = self.system.covariance(estimated)
        return joint

    def T_lidar_target(self, scan: str, target: str) -> tuple[Floats, Floats]:
        """Return T_lidar_target (4, 4) and the covariance (6, 6) of its right perturbation, rotation first."""
        joint = self.covariance([scan], [target])
        T = inverse(self.T_world_lidar[scan]) @ self.T_world_target[target]
        # T = T_l^-1 T_t moves by xi_t - Ad(T^-1) xi_l.
        J = np.hstack([-adjoint(inverse(T)), np.eye(6)])
        return T, J @ joint @ J.T

    def _require_observable(self, keys: Sequence[int]) -> None:
        null = self.system.unobservable
        if not null.size:
            return
        moving = [k for k in range(null.shape[1]) if any(_moves(null[:, k], self.system.columns[key]) for key in keys)]
        if moving:
            texts = tuple(self.unobservable[k].text for k in moving)
            raise UnobservableError(f"no covariance, since not observable: {'; '.join(texts)}", texts)


def describe_unobservable(system: LinearSystem, names: Mapping[int, str]) -> tuple[UnobservableDirection, ...]:
    """Put the unobservable directions of a linear system in words.

    Args:
        system: the linearised graph.
        names: of its variables, by key; others go by their symbol.
    """
    directions = []
    for direction in system.unobservable.T:
        motion = {
            names.get(key, gtsam.DefaultKeyFormatter(key)): direction[columns]
            for key, columns in system.columns.items()
            if _moves(direction, columns)
        }
        first = max(motion, key=lambda name: float(np.abs(motion[name]).max()))
        others = [name for name in motion if name != first]
        text = f"{first}: {_in_words(motion[first])}"
        if others:
            text += f", moving {', '.join(others[:3])}{f' and {len(others) - 3} more' if len(others) > 3 else ''} along"
        directions.append(UnobservableDirection(text, motion))
    return tuple(directions)


def _moves(direction: Floats, columns: slice) -> bool:
    return bool(np.abs(direction[columns]).max() > MOVES * np.abs(direction).max())


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


def _size(columns: slice) -> int:
    return int(columns.stop - columns.start)
