"""Several scans and several targets as one factor graph: variables, factors, exact cost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.factors import TemplateFactor, summarise
from optshape_graph.graph.initial import initialise
from optshape_graph.graph.observation import Observation
from optshape_graph.graph.solution import Residual
from optshape_graph.se3 import PoseLike, as_transform, inverse, vec


@dataclass(frozen=True, eq=False)
class TargetGraph:
    """LiDAR poses X(i) and target poses L(j), linked by template measurements; what is known is no variable.

    Make one with `build`; it takes no part in solving, which `solve` does.

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

    def poses(self, values: gtsam.Values) -> tuple[dict[str, Floats], dict[str, Floats]]:
        """Return T_world_lidar and T_world_target (4, 4) by name, known ones included."""
        lidars, targets = (
            {name: values.atPose3(keys[name]).matrix() if name in keys else T for name, T in poses.items()}
            for keys, poses in ((self.lidar_keys, self.T_world_lidar), (self.target_keys, self.T_world_target))
        )
        return lidars, targets

    def relative_poses(self, values: gtsam.Values) -> Floats:
        """Return T_target_lidar (m, 4, 4) of every observation."""
        lidars, targets = self.poses(values)
        T_world_target = np.stack([targets[o.target] for o in self.observations])
        return np.asarray(inverse(T_world_target) @ np.stack([lidars[o.scan] for o in self.observations]))

    def factors(self, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
        """Return the compiled factors, summarised at given values: exact there, to first order."""
        graph = gtsam.NonlinearFactorGraph()
        summaries = summarise([o.measurement for o in self.observations], self.relative_poses(values))
        for o, summary in zip(self.observations, summaries, strict=True):
            k_lidar, k_target = self.lidar_keys.get(o.scan), self.target_keys.get(o.target)
            if k_lidar is not None and k_target is not None:
                graph.push_back(summary.factor(k_target, k_lidar))
            elif k_target is not None:
                graph.push_back(summary.landmark_factor(k_target, self.T_world_lidar[o.scan]))
            elif k_lidar is not None:
                graph.push_back(TemplateFactor(o.measurement, k_lidar, inverse(self.T_world_target[o.target])))
        return graph

    def error(self, values: gtsam.Values) -> float:
        """Return half the chi-square of all measurements, exact."""
        return 0.5 * float(self._chi2(self.relative_poses(values)).sum())

    def residuals(self, values: gtsam.Values) -> tuple[Residual, ...]:
        """Return how well each measurement fits."""
        H = self.relative_poses(values)
        summaries = summarise([o.measurement for o in self.observations], H)
        return tuple(
            Residual(o.scan, o.target, float(chi2), o.measurement.n_rows, max(float(chi2) - 2 * summary.floor, 0.0))
            for o, summary, chi2 in zip(self.observations, summaries, self._chi2(H), strict=True)
        )

    @cached_property
    def _stacks(self) -> Floats:
        return np.stack([o.measurement.stack for o in self.observations])

    def _chi2(self, T_target_lidar: Floats) -> Floats:
        z = vec(T_target_lidar)
        rows = np.einsum("mij,mj->mi", self._stacks[..., :12], z) + self._stacks[..., 12]
        return np.asarray(np.square(rows).sum(axis=1))


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
