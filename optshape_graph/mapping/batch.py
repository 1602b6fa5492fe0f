"""The whole map at once: Gauss-Newton on the exact factors, over all sessions, at the cost of a few sparse solves.

In every iteration all measurements are linearised together, as arrays, where they are: that is what a summary made
there would contribute, without making it. Odometry and priors are GTSAM's. The step is GTSAM's multifrontal Cholesky.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, V, X

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.factors import SummaryFactor
from optshape_graph.factors._rows import gaussian
from optshape_graph.mapping.batch_solution import BatchSolution, Residual, pose_graph
from optshape_graph.mapping.biases import Biases
from optshape_graph.mapping.landmark_graph import LOSS
from optshape_graph.mapping.priors import joint_prior, sqrt_information
from optshape_graph.mapping.shapes import Shapes
from optshape_graph.mapping.track import Keys, MappingProblem
from optshape_graph.se3 import adjoint, inverse, vec, vec_derivative

__all__ = ["BatchSolution", "Residual", "factor_graph", "pose_graph", "solve_batch"]

MAX_ITERATIONS = 50
"""Iterations at most."""

CONVERGED = 1e-4
"""Decrease of the cost, in half a chi-square, promised by a step that is the last one: about a hundredth of a standard
deviation, and what is left after it is far less."""

RIDGE = 1e-12
"""Information added in all directions, relative to a match's own."""

ROUNDING = 1e-12
"""Relative rise of the cost that is rounding."""

MOST_HALVINGS = 12
"""How often a step that raises the cost is halved before it is given up."""


def solve_batch(
    problem: MappingProblem, *, robust: bool = True, as_built_sigma: float | None = None, ring_biases: bool = True
) -> BatchSolution:
    """Solve for all poses and landmarks.

    Args:
        problem: of one or several sessions.
        robust: Huber's loss on every match, as in the incremental solver; otherwise least squares.
        as_built_sigma: standard deviation of the vertices about the template, metres: refines the vertices of each
            landmark whose sightings have their `shape`; None: templates are exact.
        ring_biases: whether the biases that a LiDAR's rings keep are solved for, by sightings that have them
            (`Sighting.biased`); otherwise each match takes them for its own.

    Raises:
        InputError: nothing to solve for.
        EstimationError: the measurements do not determine poses and landmarks.
    """
    if not problem.tracks or not sum(len(track.stamps) for track in problem.tracks):
        raise InputError("a map without a pose: nothing to solve for")
    return _Batch(problem, robust, as_built_sigma, ring_biases).solve()


class _Batch:
    """A problem as arrays: the exact cost and its Gauss-Newton model anywhere."""

    def __init__(
        self, problem: MappingProblem, robust: bool = True, sigma: float | None = None, ring_biases: bool = False
    ) -> None:
        self.problem = problem
        self.loss = LOSS if robust else np.inf
        matches = [match for track in problem.tracks for match in track.matches]
        self.shapes = Shapes.of(problem, sigma)
        self.biases = Biases.of(problem, ring_biases, self.shapes.replaced)
        offset = np.cumsum([0] + [len(track.stamps) for track in problem.tracks])
        poses = tuple(tuple(X(int(k)) for k in range(a, b)) for a, b in pairwise(offset))
        names = list(problem.T_world_target)
        number = {name: k for k, name in enumerate(names)}
        self.keys = Keys(
            poses,
            {name: L(k) for k, name in enumerate(names)},
            {name: V(number[name]) for name in self.shapes.targets},
            {t: B(t) for t, found in enumerate(self.biases.errors) if found},
        )
        all_poses = [key for keys in poses for key in keys]
        self.pose = np.array([offset[t] + m.pose for t, track in enumerate(problem.tracks) for m in track.matches], int)
        self.landmark = np.array([number[match.landmark] for match in matches], int)
        self.k_lidar = [all_poses[k] for k in self.pose]
        self.k_target = [L(number[match.landmark]) for match in matches]
        measurements = [match.measurement for match in matches]
        self.L = np.array([m.L for m in measurements]).reshape(-1, 12, 12)
        self.b = np.array([m.b for m in measurements]).reshape(-1, 12)
        self.constant = np.where(self.biases.replaced, 0.0, [m.c**2 for m in measurements])
        self.others = self._others()

    def solve(self) -> BatchSolution:
        values = self._initial()
        error, iterations = self._cost(values), 0
        if not np.isfinite(error):
            raise EstimationError(f"the cost of the initial map is {error}: a measurement is not finite there")
        converged = False
        ordering: gtsam.Ordering | None = None  # what links what stays the same
        while not converged and iterations < MAX_ITERATIONS:
            linear = self._linearise(values)
            if ordering is None:
                ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
            try:
                step = linear.optimize(ordering)
            except RuntimeError as problem:
                raise EstimationError(f"poses and landmarks are not determined: {problem}") from problem
            converged = -0.5 * linear.gradientAtZero().dot(step) < CONVERGED
            moved, lower = self._descend(values, step, error)
            if lower > error * (1 + ROUNDING):
                self._cost(values)  # the model is of these
                break
            values, error = moved, lower
            iterations += 1
        chi2, weight = self._chi2_and_weight()
        return BatchSolution(
            problem=self.problem,
            values=values,
            error=error,
            converged=converged,
            iterations=iterations,
            chi2=chi2,
            weight=weight,
            linearise=partial(self._linearise, values),
            keys=self.keys,
            templates=self.shapes.refined(self.problem, values, self.keys.shapes),
        )

    def _descend(self, values: gtsam.Values, step: gtsam.VectorValues, error: float) -> tuple[gtsam.Values, float]:
        """Take the step, halved until the cost does not rise."""
        for _ in range(MOST_HALVINGS):
            moved = values.retract(step)
            lower = self._cost(moved)
            if lower <= error * (1 + ROUNDING):
                break
            step = step.scale(0.5)
        return moved, lower

    def _initial(self) -> gtsam.Values:
        values = gtsam.Values()
        for keys, track in zip(self.keys.poses, self.problem.tracks, strict=True):
            for key, T in zip(keys, track.T_world_lidar, strict=True):
                values.insert(key, gtsam.Pose3(T))
        for name, T in self.problem.T_world_target.items():
            values.insert(self.keys.landmarks[name], gtsam.Pose3(T))
        self.shapes.insert(values, self.keys.shapes)
        self.biases.insert(values, self.keys.biases)
        return values

    def _others(self) -> gtsam.NonlinearFactorGraph:
        """Odometry, starts, what was known of landmarks, and templates as priors of as-built vertices."""
        graph = gtsam.NonlinearFactorGraph()
        for keys, track in zip(self.keys.poses, self.problem.tracks, strict=True):
            if track.start is not None:
                noise = gaussian(sqrt_information(track.start.covariance))
                graph.push_back(gtsam.PriorFactorPose3(keys[0], gtsam.Pose3(track.start.T_world_lidar), noise))
            for odometry in track.odometry:
                noise = gaussian(odometry.sqrt_information)
                T = gtsam.Pose3(odometry.T_i_j)
                graph.push_back(gtsam.BetweenFactorPose3(keys[odometry.i], keys[odometry.j], T, noise))
        known = self.problem.known
        if known is not None and known.landmarks:
            ids = [self.keys.landmarks[landmark.id] for landmark in known.landmarks]
            for factor in joint_prior(ids, [m.T_world_target for m in known.landmarks], known.covariance):
                graph.push_back(factor)
        self.shapes.add_priors(graph, self.keys.shapes)
        return graph

    def _relative(self, values: gtsam.Values) -> Floats:
        """(K, 4, 4) T_target_lidar of every match."""
        world = _poses(values)  # sorted by key: L before X
        landmarks, poses = world[: len(self.keys.landmarks)], world[len(self.keys.landmarks) :]
        return np.asarray(inverse(landmarks[self.landmark]) @ poses[self.pose])

    def _model(self, H: Floats) -> _Model:
        """Return the Gauss-Newton model of every match at T_target_lidar (K, 4, 4)."""
        Jr = self.L @ np.concatenate([vec_derivative(H), vec(H)[..., None]], axis=2)
        Jr[..., 6] += self.b
        G = np.swapaxes(Jr, 1, 2) @ Jr
        # A sighting that leaves a direction open has no square root; this much is far below what anything measures.
        ridge = RIDGE * np.trace(G[:, :6, :6], axis1=1, axis2=2)
        G += ridge[:, None, None] * np.eye(7)
        C = np.linalg.cholesky(G)  # of [J r]^T [J r]: [R d; 0 sqrt(floor)] transposed
        return _Model(H, np.swapaxes(C[:, :6, :6], 1, 2).copy(), C[:, 6, :6].copy(), np.square(C[:, 6, 6]) - ridge)

    def _cost(self, values: gtsam.Values) -> float:
        """Half the chi-square, exact. The models made on the way are kept, for `_linearise` at the same values."""
        self.model = self._model(self._relative(values))
        among = self.biases.matches
        if len(among):
            self.biased = self.biases.at(self.model.H[among], values, self.keys.biases)
            self.model.R[among], self.model.d[among], self.model.floor[among] = self.biased.R, self.biased.d, 0.0
        chi2, weight = self._chi2_and_weight()
        # Huber: quadratic up to the loss, then a line; what no pose takes away counts in full.
        line = weight < 1.0
        huber = chi2.copy()
        huber[line] = 2 * self.loss * np.sqrt(chi2[line]) - self.loss**2
        cost = 0.5 * float((self.model.floor + self.constant + huber)[~self.shapes.replaced].sum())
        cost += self.biased.error if len(among) else 0.0
        return cost + self.shapes.error(values, self.keys) + float(self.others.error(values))

    def _chi2_and_weight(self) -> tuple[Floats, Floats]:
        """(K,) chi-square that each match's own best pose would take away, and the weight that the loss gives it."""
        chi2 = np.square(self.model.d).sum(axis=1)
        return chi2, np.minimum(1.0, self.loss / np.sqrt(np.maximum(chi2, 1e-12)))

    def _linearise(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """Linearise at the values whose cost was asked for last."""
        model = self.model
        root = np.sqrt(self._chi2_and_weight()[1])
        R, b = model.R * root[:, None, None], -model.d * root[:, None]
        by_target = -R @ adjoint(inverse(model.H))
        linear = self.others.linearize(values)
        unit = gtsam.noiseModel.Unit.Create(6)
        k_lidar, k_target = self.k_lidar, self.k_target
        for k in np.flatnonzero(~self.shapes.replaced & ~self.biases.replaced).tolist():
            linear.push_back(gtsam.JacobianFactor(k_target[k], by_target[k], k_lidar[k], R[k], b[k], unit))
        for n, (k, t) in enumerate(zip(self.biases.matches.tolist(), self.biases.track.tolist(), strict=True)):
            by_bias = self.biased.E[n, :, : len(self.biases.errors[t])] * root[k]
            linear.add(k_target[k], by_target[k], k_lidar[k], R[k], self.keys.biases[t], by_bias, b[k], unit)
        for t, key in self.keys.biases.items():
            rows, m = self.biased.alone[t], len(self.biases.errors[t])
            linear.add(key, rows[:, :m], -rows[:, -1], gtsam.noiseModel.Unit.Create(len(rows)))
        self.shapes.linearise(linear, values, self.keys)
        return linear


@dataclass(frozen=True, eq=False)
class _Model:
    """Gauss-Newton model 1/2 ||R xi + d||^2 + 1/2 floor of K matches, xi the right perturbation of H.

    Attributes:
        H: (K, 4, 4) T_target_lidar.
        R: (K, 6, 6) upper triangular.
        d: (K, 6).
        floor: (K,) what no pose takes away, to first order.
    """

    H: Floats
    R: Floats
    d: Floats
    floor: Floats


def factor_graph(problem: MappingProblem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return a problem as plain GTSAM factors and initial values, for those who own their graph.

    Every match is a compiled Between factor, summarised at the initial values: make them again (`SummaryFactor`) when
    those have moved.
    """
    batch = _Batch(problem)
    graph, values = gtsam.NonlinearFactorGraph(batch.others), batch._initial()
    loss = gtsam.noiseModel.mEstimator.Huber.Create(LOSS)
    H = batch._relative(values)
    matches = [(t, match) for t, track in enumerate(problem.tracks) for match in track.matches]
    for (t, match), T in zip(matches, H, strict=True):
        k_target, k_lidar = batch.keys.landmarks[match.landmark], batch.keys.poses[t][match.pose]
        graph.push_back(SummaryFactor(match.measurement, k_target, k_lidar, T, loss))
    return graph, values


def _poses(values: gtsam.Values) -> Floats:
    """(N, 4, 4) all poses, in the order of their keys."""
    rows = gtsam.utilities.extractPose3(values)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    T[:, :3, 3] = rows[:, 9:]
    return T
