"""A solved map: its estimates, how well each match fits, covariances, and the pose graph that it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, V, X

from optshape_graph._arrays import Floats, Value
from optshape_graph.errors import UnobservableError
from optshape_graph.factors import BiasedMeasurement, SharedError, summarise
from optshape_graph.factors.static import RANGE_BIAS
from optshape_graph.graph import Chain, Chains, Inverse, Solution
from optshape_graph.graph.shared import Gain, gain, persistent
from optshape_graph.io.trajectories import PoseGraph, PoseGraphEdge, Trajectory
from optshape_graph.mapping.map import Landmark, Map
from optshape_graph.mapping.track import MappingProblem, Match
from optshape_graph.se3 import adjoint, inverse
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class Keys(Value):
    """Variables: poses X, landmarks L, as-built vertices V, and the biases B of LiDARs' rings.

    Attributes:
        poses: of each track.
        landmarks: by name.
        shapes: of the landmarks' vertices, by name.
        biases: by number of the track and name of the LiDAR.
    """

    poses: tuple[tuple[int, ...], ...]
    landmarks: Mapping[str, int]
    shapes: Mapping[str, int]
    biases: Mapping[tuple[int, str], int]

    @classmethod
    def of(cls, problem: MappingProblem) -> Keys:
        """Return the keys of a problem's variables."""
        offset = np.cumsum([0] + [len(track.stamps) for track in problem.tracks])
        names = list(problem.T_world_target)
        lidars = dict.fromkeys((t, match.sighting.lidar) for t, match in problem.matches)
        return cls(
            tuple(tuple(X(int(k)) for k in range(a, b)) for a, b in pairwise(offset)),
            {name: L(k) for k, name in enumerate(names)},
            {name: V(k) for k, name in enumerate(names)},
            {lidar: B(k) for k, lidar in enumerate(lidars)},
        )

    def names(self, problem: MappingProblem) -> dict[int, str]:
        """Return what messages call each pose and landmark."""
        names = {key: f"landmark '{name}'" for name, key in self.landmarks.items()}
        for track, own in zip(problem.tracks, self.poses, strict=True):
            names |= {key: f"pose {i} of '{track.name}'" for i, key in enumerate(own)}
        return names

    def chain(self, track: int, match: Match) -> Chain:
        """Return what T_target_lidar of a match is made of."""
        return [Inverse(self.landmarks[match.landmark]), self.poses[track][match.pose]]

    def chains(self, matches: Sequence[tuple[int, Match]]) -> Chains:
        """Return T_target_lidar of matches, each with the number of its track."""
        landmarks = [self.landmarks[match.landmark] for _, match in matches]
        poses = [self.poses[track][match.pose] for track, match in matches]
        return Chains.between(np.array(landmarks, np.int64), np.array(poses, np.int64))


@dataclass(frozen=True, eq=False, repr=False)
class Residual(Value):
    """How well a match fits.

    Attributes:
        track: name of the session.
        pose: number of the LiDAR pose.
        landmark: name of the landmark.
        chi2: what of the measurement's chi-square its own best pose would take away: 6 degrees of freedom.
        weight: that the robust loss gives it, 0 to 1.
    """

    track: str
    pose: int
    landmark: str
    chi2: float
    weight: float


class Judged(Protocol):
    """A term's model that says how well each of its measurements fits."""

    @property
    def chi2(self) -> Floats:
        """(m,) chi-square of each that its own best pose would take away."""

    @property
    def weight(self) -> Floats:
        """(m,) weight that the loss gives each."""


@dataclass(frozen=True, eq=False, repr=False)
class BatchSolution(Value):
    """A solved map.

    Attributes:
        problem: what was solved.
        solution: of all variables.
        keys: of the poses of each track, and of the landmarks.
        templates: of the landmarks, their vertices as built where those were refined.
        judged: numbers of the matches of each term, with what the solution's model of it says of them.
        biased: by number of the match, its measurement with what the LiDAR's rings keep: errors of ranges, which are
            variables, and others, which each match takes for its own.
        ranges: errors of ranges, in the order of a LiDAR's variable, by its key.
    """

    problem: MappingProblem
    solution: Solution
    keys: Keys
    templates: Mapping[str, Target]
    judged: Sequence[tuple[Sequence[int], Judged]]
    biased: Mapping[int, BiasedMeasurement]
    ranges: Mapping[int, tuple[SharedError, ...]]

    def __repr__(self) -> str:
        poses, landmarks = sum(map(len, self.keys.poses)), len(self.keys.landmarks)
        state = "converged" if self.converged else "not converged"
        return f"BatchSolution({poses} poses, {landmarks} landmarks, chi2 {2 * self.error:.4g}, {state})"

    @property
    def values(self) -> gtsam.Values:
        """Values of all variables."""
        return self.solution.values

    @property
    def error(self) -> float:
        """Half the chi-square, exact, robust loss applied."""
        return self.solution.error

    @property
    def converged(self) -> bool:
        """Whether a further step would gain nothing."""
        return self.solution.converged

    @property
    def iterations(self) -> int:
        """Number of steps taken."""
        return self.solution.iterations

    def trajectory(self, track: str) -> Trajectory:
        """Return the poses of a session."""
        k = [t.name for t in self.problem.tracks].index(track)
        poses = self.solution.state.poses(np.array(self.keys.poses[k], np.int64))
        return Trajectory(poses.reshape(-1, 4, 4), self.problem.tracks[k].stamps, track)

    @cached_property
    def residuals(self) -> tuple[Residual, ...]:
        """How well each match fits, in the order of tracks and matches."""
        found = {
            k: (float(chi2), float(weight))
            for numbers, model in self.judged
            for k, chi2, weight in zip(numbers, model.chi2, model.weight, strict=True)
        }
        return tuple(
            Residual(self.problem.tracks[t].name, match.pose, match.landmark, *found[k])
            for k, (t, match) in enumerate(self.problem.matches)
        )

    @property
    def landmarks(self) -> dict[str, Floats]:
        """T_world_target (4, 4) of each landmark."""
        return {name: self.solution.pose(key) for name, key in self.keys.landmarks.items()}

    def covariance(self, landmarks: Sequence[str] = (), poses: Sequence[tuple[str, int]] = ()) -> Floats:
        """Return the joint covariance of landmarks and poses (session, number), right perturbations, rotation first.

        Raises:
            UnobservableError: something is not determined by what was measured.
        """
        names = [track.name for track in self.problem.tracks]
        keys = [self.keys.landmarks[name] for name in landmarks]
        keys += [self.keys.poses[names.index(track)][number] for track, number in poses]
        try:
            plain = self.solution.covariance(keys)
        except UnobservableError as error:
            raise UnobservableError(f"the map is not determined: {error}", error.directions) from error
        return persistent(self.solution.system, keys, self._gains()) if self.biased else plain

    def _gains(self) -> Iterator[Gain]:
        """What errors that each match took for its own add to the information vector, by match; see `persistent`."""
        system, numbers = self.solution.system, list(self.biased)
        matches = [self.problem.matches[k] for k in numbers]
        relative = self.keys.chains(matches).at(self.solution.state)
        weights = [self.residuals[k].weight for k in numbers]
        for (t, match), measurement, H, weight in zip(matches, self.biased.values(), relative, weights, strict=True):
            own = [error for error in measurement.shared if error.kind != RANGE_BIAS]
            G, key = gain(measurement, H, own, weight), self.keys.biases[t, match.sighting.lidar]
            ranges = [self.ranges[key].index(error) for error in measurement.shared if error.kind == RANGE_BIAS]
            target = system.index([self.keys.landmarks[match.landmark]])
            lidar = system.index([self.keys.poses[t][match.pose]])
            blocks = [(target, -adjoint(inverse(H)).T @ G[:6]), (lidar, G[:6]), (system.index([key])[ranges], G[6:])]
            yield Gain(blocks, [match.kept(error, t) for error in own])

    def map(self) -> Map:
        """Return the map.

        Raises:
            EstimationError: it is not determined by what was measured.
        """
        names = list(self.keys.landmarks)
        joint = self.covariance(names) if names else np.zeros((0, 0))
        seen = Counter(match.landmark for _, match in self.problem.matches)
        known = {} if self.problem.known is None else {m.id: m.observations for m in self.problem.known.landmarks}
        landmarks = []
        for k, (name, T) in enumerate(self.landmarks.items()):
            block = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
            landmarks.append(Landmark(name, self.templates[name], T, block, seen[name] + known.get(name, 0)))
        earlier = {} if self.problem.known is None else dict(self.problem.known.trajectories)
        trajectories = earlier | {t.name: self.trajectory(t.name) for t in self.problem.tracks}
        return Map(tuple(landmarks), joint if names else None, trajectories)


def pose_graph(solution: BatchSolution) -> PoseGraph:
    """Return a solved map as a pose graph, for g2o: poses first, then landmarks; summaries at the solution as edges."""
    problem, state, keys = solution.problem, solution.solution.state, solution.keys
    order = [key for track in keys.poses for key in track] + list(keys.landmarks.values())
    number = {key: k for k, key in enumerate(order)}
    edges = []
    for own, track in zip(keys.poses, problem.tracks, strict=True):
        for o in track.odometry:
            information = np.asarray(np.linalg.inv(o.covariance), float)
            edges.append(PoseGraphEdge(number[own[o.i]], number[own[o.j]], o.T_i_j, information))
    relative = Chains([keys.chain(t, match) for t, match in problem.matches]).at(state)
    summaries = summarise([match.measurement for _, match in problem.matches], relative)
    for (t, match), summary in zip(problem.matches, summaries, strict=True):
        information = summary.sqrt_information.T @ summary.sqrt_information
        a, b = number[keys.landmarks[match.landmark]], number[keys.poses[t][match.pose]]
        edges.append(PoseGraphEdge(a, b, summary.T_target_lidar, information))
    fixed = frozenset(
        number[own[0]] for own, track in zip(keys.poses, problem.tracks, strict=True) if track.start is not None
    )
    vertices = dict(enumerate(state.poses(np.array(order, np.int64))))
    return PoseGraph(vertices, tuple(edges), fixed)
