"""Several scans and several targets by name: what is known of their poses, what was measured, and what follows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from optshape_graph._arrays import Floats, Value
from optshape_graph.errors import InputError
from optshape_graph.graph.chain import Chain, Inverse, Step
from optshape_graph.graph.initial import initialise
from optshape_graph.graph.observation import Observation
from optshape_graph.graph.solution import Solution, UnobservableDirection
from optshape_graph.graph.solve import solve
from optshape_graph.graph.terms import Templates, Term
from optshape_graph.se3 import PoseLike, as_transform, inverse


@dataclass(frozen=True, eq=False, repr=False)
class TargetGraph(Value):
    """LiDAR poses X(i) and target poses L(j), linked by template measurements; what is known is no variable.

    Make one with `build`.

    Attributes:
        observations: the measurements; of symmetric targets, the equivalent ones that agree with the initial poses.
        T_world_lidar: (4, 4) of each scan, known or initial.
        T_world_target: (4, 4) of each target, known or initial.
        lidar_keys: key of each unknown LiDAR pose.
        target_keys: key of each unknown target pose.
    """

    observations: tuple[Observation, ...]
    T_world_lidar: Mapping[str, Floats]
    T_world_target: Mapping[str, Floats]
    lidar_keys: Mapping[str, int]
    target_keys: Mapping[str, int]

    def initial_values(self) -> gtsam.Values:
        """Return the initial poses of the variables."""
        values = gtsam.Values()
        for keys, poses in ((self.lidar_keys, self.T_world_lidar), (self.target_keys, self.T_world_target)):
            for name, key in keys.items():
                values.insert(key, gtsam.Pose3(poses[name]))
        return values

    def chain(self, observation: Observation) -> Chain:
        """Return what T_target_lidar of an observation is made of."""
        k_lidar, k_target = self.lidar_keys.get(observation.scan), self.target_keys.get(observation.target)
        lidar: Step = self.T_world_lidar[observation.scan] if k_lidar is None else k_lidar
        target: Step = inverse(self.T_world_target[observation.target]) if k_target is None else Inverse(k_target)
        return [target, lidar]

    def term(self) -> Templates:
        """Return the measurements as a term of a graph."""
        return Templates.of([o.measurement for o in self.observations], [self.chain(o) for o in self.observations])

    def solve(
        self,
        factors: gtsam.NonlinearFactorGraph | None = None,
        values: gtsam.Values | None = None,
        terms: Sequence[Term] = (),
    ) -> TargetSolution:
        """Solve for all unknown poses.

        Args:
            factors: what else there is (priors, odometry, markers), on the graph's keys and others.
            values: initial values of variables that only those have.
            terms: what else there is and is no GTSAM factor.

        Raises:
            EstimationError: a factor is not finite.
            InputError: nothing is unknown, a variable has no initial value, or a factor is a hard constraint.
        """
        initial = self.initial_values()
        if values is not None:
            initial.insert(values)
        names = {key: f"T_world_lidar[{name}]" for name, key in self.lidar_keys.items()}
        names |= {key: f"T_world_target[{name}]" for name, key in self.target_keys.items()}
        return TargetSolution(self, solve(initial, [self.term(), *terms], factors, names))


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


@dataclass(frozen=True, eq=False, repr=False)
class TargetSolution(Value):
    """Solved poses of scans and targets, by name.

    Attributes:
        graph: what was solved.
        solution: of its variables.
    """

    graph: TargetGraph
    solution: Solution

    def __repr__(self) -> str:
        scans, targets = len(self.graph.T_world_lidar), len(self.graph.T_world_target)
        return f"TargetSolution({scans} scans, {targets} targets, {self.solution})"

    @property
    def converged(self) -> bool:
        """Whether a further step would gain nothing."""
        return self.solution.converged

    @property
    def error(self) -> float:
        """Half the chi-square of all measurements and other factors, exact."""
        return self.solution.error

    @property
    def values(self) -> gtsam.Values:
        """Values of all variables, those of other factors included."""
        return self.solution.values

    @property
    def unobservable(self) -> tuple[UnobservableDirection, ...]:
        """Directions that the graph does not determine; empty when all is well."""
        return self.solution.unobservable

    @cached_property
    def T_world_lidar(self) -> Mapping[str, Floats]:
        """(4, 4) of every scan, known or estimated."""
        return self._poses(self.graph.T_world_lidar, self.graph.lidar_keys)

    @cached_property
    def T_world_target(self) -> Mapping[str, Floats]:
        """(4, 4) of every target, known or estimated."""
        return self._poses(self.graph.T_world_target, self.graph.target_keys)

    @cached_property
    def residuals(self) -> tuple[Residual, ...]:
        """How well each observation fits, in their order."""
        model = self.graph.term().at(self.solution.state)
        return tuple(
            Residual(o.scan, o.target, float(pose + floor), o.measurement.n_rows, float(pose))
            for o, pose, floor in zip(self.graph.observations, model.chi2, model.floor, strict=True)
        )

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
            (scans, self.graph.T_world_lidar, self.graph.lidar_keys),
            (targets, self.graph.T_world_target, self.graph.target_keys),
        ):
            for name in names:
                if name not in poses:
                    raise InputError(f"'{name}' is not in the graph; it holds {', '.join(sorted(poses))}")
                wanted.append(known.get(name))
        wanted += keys
        estimated = [key for key in wanted if key is not None]
        covariance = self.solution.covariance(estimated) if estimated else np.zeros((0, 0))
        sizes = [6 if key is None else self.solution.size(key) for key in wanted]
        free = np.repeat([key is not None for key in wanted], sizes)
        joint = np.zeros((sum(sizes), sum(sizes)))
        joint[np.ix_(free, free)] = covariance
        return joint

    def T_lidar_target(self, scan: str, target: str) -> tuple[Floats, Floats]:
        """Return T_lidar_target (4, 4) and the covariance (6, 6) of its right perturbation, rotation first."""
        k_lidar, k_target = self.graph.lidar_keys.get(scan), self.graph.target_keys.get(target)
        lidar: Step = inverse(self.graph.T_world_lidar[scan]) if k_lidar is None else Inverse(k_lidar)
        return self.solution.relative([lidar, self.graph.T_world_target[target] if k_target is None else k_target])

    def _poses(self, poses: Mapping[str, Floats], keys: Mapping[str, int]) -> dict[str, Floats]:
        return {name: self.solution.pose(keys[name]) if name in keys else T for name, T in poses.items()}


def build(
    observations: Sequence[Observation],
    known_lidars: Mapping[str, PoseLike] | None = None,
    known_targets: Mapping[str, PoseLike] | None = None,
    predicted_lidars: Mapping[str, PoseLike] | None = None,
    predicted_targets: Mapping[str, PoseLike] | None = None,
) -> TargetGraph:
    """Build a graph and place its variables, from what is known and the measurements' own poses.

    When neither `known_lidars` nor `known_targets` is given, the world is the LiDAR frame of the first scan. Given but
    empty, nothing is fixed: other factors are expected to, and what they do not fix is reported as not observable.

    Args:
        observations: the measurements, one for each pair of scan and target.
        known_lidars: T_world_lidar (4, 4) of scans whose pose is known exactly.
        known_targets: T_world_target (4, 4) of targets whose pose is known exactly.
        predicted_lidars: T_world_lidar (4, 4) of scans to start from, and to choose equivalent poses by.
        predicted_targets: T_world_target (4, 4) of targets to start from.

    Raises:
        InputError: no observation, a pair that is observed twice, or a pose that is none.
    """
    if not observations:
        raise InputError("no observation to build a graph of")
    (scan, target), times = Counter((o.scan, o.target) for o in observations).most_common(1)[0]
    if times > 1:
        raise InputError(
            f"target '{target}' is observed {times} times from LiDAR pose '{scan}': fuse what is static "
            "with fuse_static, which knows what the scans have in common, or tell scans from different poses apart"
        )
    if known_lidars is None and known_targets is None:
        known_lidars = {observations[0].scan: np.eye(4)}
    lidars, targets = _poses("LiDAR", known_lidars), _poses("target", known_targets)
    placed_lidars, placed_targets = initialise(
        observations, _poses("LiDAR", predicted_lidars) | lidars, _poses("target", predicted_targets) | targets
    )
    chosen = tuple(o.nearest(inverse(placed_targets[o.target]) @ placed_lidars[o.scan]) for o in observations)
    scans, seen = dict.fromkeys(o.scan for o in observations), dict.fromkeys(o.target for o in observations)
    return TargetGraph(
        chosen,
        {name: placed_lidars[name] for name in scans},
        {name: placed_targets[name] for name in seen},
        {name: X(i) for i, name in enumerate(scans) if name not in lidars},
        {name: L(j) for j, name in enumerate(seen) if name not in targets},
    )


def _poses(kind: str, poses: Mapping[str, PoseLike] | None) -> dict[str, Floats]:
    return {name: as_transform(T, f"the pose of {kind} '{name}'") for name, T in (poses or {}).items()}
