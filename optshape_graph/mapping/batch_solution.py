"""A solved map: its estimates, how well each match fits, covariances, and the pose graph that it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.errors import EstimationError
from optshape_graph.factors import summarise
from optshape_graph.io.trajectories import PoseGraph, PoseGraphEdge, Trajectory
from optshape_graph.mapping.map import Landmark, Map
from optshape_graph.mapping.track import Keys, MappingProblem
from optshape_graph.target import Target


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


@dataclass(frozen=True, eq=False, repr=False)
class BatchSolution(Value):
    """A solved map.

    Attributes:
        problem: what was solved.
        values: all variables.
        error: half the chi-square, exact, robust loss applied.
        converged: whether a further step would gain nothing.
        iterations: steps taken.
        chi2: (K,) of each match, in the order of tracks and matches: see `Residual`.
        weight: (K,) that the robust loss gives it, a number from 0 to 1.
        linearise: makes the graph, linearised at the solution.
        keys: of the poses of each track, and of the landmarks.
        templates: of the landmarks, their vertices as built where those were refined.
    """

    problem: MappingProblem
    values: gtsam.Values
    error: float
    converged: bool
    iterations: int
    chi2: Floats
    weight: Floats
    linearise: Callable[[], gtsam.GaussianFactorGraph]
    keys: Keys
    templates: Mapping[str, Target]

    def trajectory(self, track: str) -> Trajectory:
        """Return the poses of a session."""
        k = [t.name for t in self.problem.tracks].index(track)
        poses = np.array([self.values.atPose3(key).matrix() for key in self.keys.poses[k]])
        return Trajectory(poses.reshape(-1, 4, 4), self.problem.tracks[k].stamps, track)

    @cached_property
    def residuals(self) -> tuple[Residual, ...]:
        """How well each match fits, in the order of tracks and matches."""
        named = [(track.name, match) for track in self.problem.tracks for match in track.matches]
        return tuple(
            Residual(track, match.pose, match.landmark, float(x), float(w))
            for (track, match), x, w in zip(named, self.chi2, self.weight, strict=True)
        )

    @property
    def landmarks(self) -> dict[str, Floats]:
        """T_world_target (4, 4) of each landmark."""
        return {name: self.values.atPose3(key).matrix() for name, key in self.keys.landmarks.items()}

    @cached_property
    def _marginals(self) -> gtsam.Marginals:
        return gtsam.Marginals(self.linearise(), self.values)

    def covariance(self, landmarks: Sequence[str] = (), poses: Sequence[tuple[str, int]] = ()) -> Floats:
        """Return the joint covariance of landmarks and poses (session, number), right perturbations, rotation first.

        Raises:
            EstimationError: something is not determined by what was measured.
        """
        names = [track.name for track in self.problem.tracks]
        keys = [self.keys.landmarks[name] for name in landmarks]
        keys += [self.keys.poses[names.index(track)][number] for track, number in poses]
        try:
            return np.asarray(self._marginals.jointMarginalCovariance(keys).fullMatrix())
        except RuntimeError as error:
            raise EstimationError(f"the map is not determined: {error}") from error

    def map(self) -> Map:
        """Return the map."""
        names = list(self.keys.landmarks)
        joint = self.covariance(names) if names else None
        seen = Counter(match.landmark for track in self.problem.tracks for match in track.matches)
        known = {} if self.problem.known is None else {m.id: m.observations for m in self.problem.known.landmarks}
        landmarks = []
        for k, (name, T) in enumerate(self.landmarks.items()):
            assert joint is not None  # there is a landmark
            block = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
            landmarks.append(Landmark(name, self.templates[name], T, block, seen[name] + known.get(name, 0)))
        earlier = {} if self.problem.known is None else dict(self.problem.known.trajectories)
        return Map(tuple(landmarks), joint, earlier | {t.name: self.trajectory(t.name) for t in self.problem.tracks})


def pose_graph(solution: BatchSolution) -> PoseGraph:
    """Return a solved map as a pose graph, for g2o: poses first, then landmarks; summaries at the solution as edges."""
    problem, values, keys = solution.problem, solution.values, solution.keys
    order = [key for track in keys.poses for key in track] + list(keys.landmarks.values())
    number = {key: k for k, key in enumerate(order)}
    edges = []
    for track_keys, track in zip(keys.poses, problem.tracks, strict=True):
        for o in track.odometry:
            information = np.asarray(np.linalg.inv(o.covariance), float)
            edges.append(PoseGraphEdge(number[track_keys[o.i]], number[track_keys[o.j]], o.T_i_j, information))
        targets = [keys.landmarks[match.landmark] for match in track.matches]
        lidars = [track_keys[match.pose] for match in track.matches]
        between = [values.atPose3(a).between(values.atPose3(b)).matrix() for a, b in zip(targets, lidars, strict=True)]
        summaries = summarise([m.measurement for m in track.matches], np.array(between).reshape(-1, 4, 4))
        for a, b, summary in zip(targets, lidars, summaries, strict=True):
            information = summary.sqrt_information.T @ summary.sqrt_information
            edges.append(PoseGraphEdge(number[a], number[b], summary.T_target_lidar, information))
    vertices = {k: values.atPose3(key).matrix() for key, k in number.items()}
    fixed = frozenset(
        number[track_keys[0]]
        for track_keys, track in zip(keys.poses, problem.tracks, strict=True)
        if track.start is not None
    )
    return PoseGraph(vertices, tuple(edges), fixed)
