"""A target that is carried, or a platform that moves, while it is seen: poses and twists over time, and clocks.

Every sighting has a pose L of its own, T_base_target at its time by the clocks as they are known, and a twist V, the
target's in its own frame. From one sighting to the next the twist changes by white noise of acceleration (Anderson and
Barfoot, IROS 2015): with xi = Log(L_i^-1 L_j) and h the time between them, the errors

    [xi - h V_i ; J_r^-1(xi) V_j - V_i]      have the covariance      [h^3/3 h^2/2; h^2/2 h] (x) diag(q),

q being the density of the acceleration, of rotation and of translation. A clock that is ahead by d more than it is
taken to be saw the target at L Exp(-d V).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.rig.points import Seen
from optshape_graph.graph import Chains, Inverse, State, add_rows
from optshape_graph.se3 import adjoint, exp, inverse, inverse_right_jacobian, log, skew

CLOCK_SIGMA = 0.05
"""Standard deviation of the prior of a clock's offset about what it was last taken to be, seconds: it says nothing."""

SHORTEST = 1e-4
"""Time between two sightings, seconds, at least."""

START_DENSITY = (1.0, 1.0)
"""Densities of acceleration to begin with: rad^2/s^3 and m^2/s^3."""

LEAST_DENSITY = 1e-4
"""Densities at least."""


@dataclass(frozen=True, eq=False, repr=False)
class Track(Value):
    """One target's sightings while it moves, in the order of their times.

    Attributes:
        numbers: (n,) of the sightings.
        times: (n,) seconds, by the first sensor's clock.
        twists: (n, 6) of the target in its own frame, rotation first, rad/s and m/s, as far as they are known.
    """

    numbers: tuple[int, ...]
    times: Floats
    twists: Floats


@dataclass(frozen=True, eq=False, repr=False)
class Smooth(Value):
    """The motion between sightings of one target that follow each other, as a term.

    Attributes:
        chains: L_i^-1 L_j.
        poses: (m, 2) keys of L_i and L_j.
        twists: (m, 2) keys of V_i and V_j.
        seconds: (m,) times between them, seconds.
        whiten: (m, 12, 12) square root information of the errors.
    """

    chains: Chains
    poses: tuple[tuple[int, int], ...]
    twists: tuple[tuple[int, int], ...]
    seconds: Floats
    whiten: Floats

    @classmethod
    def of(
        cls, poses: Sequence[tuple[int, int]], twists: Sequence[tuple[int, int]], seconds: Floats, density: Floats
    ) -> Smooth:
        """Return the term of pairs of sightings.

        Args:
            poses: keys of L_i and L_j.
            twists: keys of V_i and V_j.
            seconds: (m,) times between them, seconds.
            density: (2,) of acceleration: rotation, rad^2/s^3, and translation, m^2/s^3.
        """
        h = np.maximum(seconds, SHORTEST)
        Q = np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]]).transpose(2, 0, 1)
        root = np.linalg.inv(np.linalg.cholesky(Q))
        D = np.diag(np.repeat(1.0 / np.sqrt(density), 3))
        whiten = np.einsum("mij,kl->mikjl", root, D).reshape(-1, 12, 12)
        return cls(Chains([[Inverse(i), j] for i, j in poses]), tuple(poses), tuple(twists), h, whiten)

    def at(self, state: State) -> SmoothModel:
        """Return the Gauss-Newton model at a state."""
        T = self.chains.at(state)
        xi = log(T)
        V = np.array([[state.values.atVector(key) for key in pair] for pair in self.twists]).reshape(-1, 2, 6)
        J = inverse_right_jacobian(xi)
        h = self.seconds[:, None]
        turned = (J @ V[:, 1, :, None])[..., 0]
        e = np.concatenate([xi - h * V[:, 0], turned - V[:, 0]], axis=1)
        by_xi = np.concatenate([np.broadcast_to(np.eye(6), J.shape), -0.5 * _ad(V[:, 1])], axis=1)
        by_j = by_xi @ J
        by_i = -by_j @ adjoint(inverse(T))
        one = np.broadcast_to(np.eye(6), J.shape)
        by_V_i = np.concatenate([-h[..., None] * one, -one], axis=1)
        by_V_j = np.concatenate([np.zeros_like(J), J], axis=1)
        blocks = tuple(self.whiten @ block for block in (by_i, by_j, by_V_i, by_V_j))
        return SmoothModel(self, (self.whiten @ e[..., None])[..., 0], blocks)


@dataclass(frozen=True, eq=False, repr=False)
class SmoothModel(Value):
    """The motion between sightings, at a state.

    Attributes:
        term: that this is the model of.
        e: (m, 12) whitened errors.
        blocks: (m, 12, 6) derivatives, whitened, by L_i, L_j, V_i and V_j.
    """

    term: Smooth
    e: Floats
    blocks: tuple[Floats, ...]

    @property
    def error(self) -> float:
        """Half the chi-square."""
        return 0.5 * float(np.square(self.e).sum())

    def keys(self, m: int) -> list[int]:
        """Return the keys of a pair's variables, in the order of the blocks."""
        return [*self.term.poses[m], *self.term.twists[m]]

    def add_to(self, linear: gtsam.GaussianFactorGraph) -> None:
        """Add the linearisation to a graph."""
        for m, e in enumerate(self.e):
            add_rows(linear, self.keys(m), [block[m] for block in self.blocks], -e)


@dataclass(frozen=True, eq=False, repr=False)
class Timed(Value):
    """Points of a target that moves; the last of beta is the clock's offset, in CLOCK_SIGMA.

    Attributes:
        seen: the points.
        twist: (6,) of the target in its own frame, rotation first, rad/s and m/s.
    """

    seen: Seen
    twist: Floats

    def whitened(self, T_sensor_target: Floats, beta: Floats) -> tuple[Floats, Floats, Floats]:
        """See `Seen.whitened`."""
        back = exp(-CLOCK_SIGMA * beta[-1] * self.twist)
        r, by_pose, by_beta = self.seen.whitened(T_sensor_target @ back, beta[:-1])
        # T Exp(x) B = T B Exp(Ad(B^-1) x)
        by_clock = by_pose @ (-CLOCK_SIGMA * self.twist)
        return r, by_pose @ adjoint(inverse(back)), np.column_stack([by_beta, by_clock])


def estimate_density(model: SmoothModel, covariances: Mapping[int, Floats], density: Floats) -> Floats:
    """Return the density of acceleration that makes the motion likeliest: a step of expectation maximisation.

    Args:
        model: the motion, at the solution.
        covariances: (24, 24) of some pairs' variables, by number of the pair, in the order of its blocks.
        density: (2,) that the model was made with, rad2/s3 and m2/s3.

    Returns:
        (2,) rad2/s3 and m2/s3.
    """
    squares = np.zeros((len(covariances), 12))
    for k, (m, covariance) in enumerate(covariances.items()):
        J = np.hstack([block[m] for block in model.blocks])
        squares[k] = np.square(model.e[m]) + np.einsum("ij,jk,ik->i", J, covariance, J)
    rotation, translation = (float(squares[:, [*range(a, a + 3), *range(a + 6, a + 9)]].mean()) for a in (0, 3))
    return np.maximum(density * [rotation, translation], LEAST_DENSITY)


def _ad(V: Floats) -> Floats:
    """(m, 6, 6) ad(V): ad(V) x = [V, x], rotation first."""
    W, v = skew(V[:, :3]), skew(V[:, 3:])
    return np.concatenate([np.concatenate([W, np.zeros_like(W)], axis=2), np.concatenate([v, W], axis=2)], axis=1)
