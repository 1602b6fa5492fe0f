"""Two maps with landmarks in common become one, in the frame of the first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E, L

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.graph import Chain, Chains, Inverse, JointPoses, solve
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.mapping.map import Landmark, Map
from optshape_graph.mapping.smoother import sqrt_information
from optshape_graph.se3 import adjoint, inverse, inverse_covariance


def merge_maps(a: Map, b: Map) -> Map:
    """Return the map that two maps make, made independently of each other, in the frame of the first.

    Landmarks of one name are one. Unknowns are all landmarks in the first map's frame and T_a_b between the maps; both
    maps are joint Gaussian measurements of them.

    Raises:
        InputError: no landmark in common, one of another template, or sessions of one name.
        EstimationError: it does not converge.
    """
    common = [landmark for landmark in b.landmarks if landmark.id in {known.id for known in a.landmarks}]
    if not common:
        raise InputError("the maps have no landmark in common: nothing says where one is in the other")
    for landmark in common:
        if len(landmark.target) != len(a[landmark.id].target):
            raise InputError(f"landmark '{landmark.id}' is a '{a[landmark.id].target.name}' in one map and a "
                             f"'{landmark.target.name}' in the other")  # fmt: skip
    if same := a.trajectories.keys() & b.trajectories.keys():
        raise InputError(f"both maps have a session '{min(same)}'")
    T_a_b, b = _aligned(a, b)
    names = list(dict.fromkeys([landmark.id for landmark in (*a.landmarks, *b.landmarks)]))
    keys = {name: L(k) for k, name in enumerate(names)}
    values = gtsam.Values()
    values.insert(E(0), gtsam.Pose3(T_a_b))
    poses = {landmark.id: T_a_b @ landmark.T_world_target for landmark in b.landmarks}
    poses |= {landmark.id: landmark.T_world_target for landmark in a.landmarks}
    for name, T in poses.items():
        values.insert(keys[name], gtsam.Pose3(T))
    # The first map's frame is the world: only the second one's moves.
    solution = solve(values, [_measured(a, [[keys[m.id]] for m in a.landmarks]),
                              _measured(b, [[Inverse(E(0)), keys[m.id]] for m in b.landmarks])])  # fmt: skip
    if not solution.converged:
        raise EstimationError("merging the maps did not converge")
    T_a_b, joint = solution.pose(E(0)), solution.covariance(list(keys.values()))
    moved = {name: Trajectory(T_a_b @ t.poses, t.stamps, t.name) for name, t in b.trajectories.items()}
    return Map(
        _landmarks(a, b, {name: solution.pose(key) for name, key in keys.items()}, joint),
        joint,
        {**a.trajectories, **moved},
    )


def _aligned(a: Map, b: Map) -> tuple[Floats, Map]:
    """A first T_a_b, and the second map with the vertices of symmetric targets named as in the first."""
    names = [landmark.id for landmark in a.landmarks]
    common = [landmark for landmark in b.landmarks if landmark.id in names]

    def mismatch(T: Floats) -> float:
        there = np.array([a[m.id].T_world_target for m in common])
        here = np.array([m.target.nearest_equivalent(T @ m.T_world_target, a[m.id].T_world_target) for m in common])
        return float(np.square((here - there)[:, :3]).sum())

    starts = [
        a[m.id].T_world_target @ inverse(m.T_world_target @ S) for m in common for S in m.target.symmetry_transforms
    ]
    T_a_b = min(starts, key=mismatch)
    named = [_turned(m, T_a_b, a[m.id].T_world_target) if m.id in names else m for m in b.landmarks]
    return T_a_b, replace(b, landmarks=tuple(named), joint_covariance=_turned_covariance(b, named))


def _turned(landmark: Landmark, T_a_b: Floats, T_a_target: Floats) -> Landmark:
    """The landmark of the second map, its vertices named as those of T_a_target (4, 4) in the first."""
    S = landmark.target.symmetry_transforms[
        landmark.target.nearest_symmetry(T_a_b @ landmark.T_world_target, T_a_target)
    ]
    covariance = inverse_covariance(inverse(S), landmark.covariance)
    return replace(landmark, T_world_target=landmark.T_world_target @ S, covariance=covariance)


def _turned_covariance(b: Map, named: list[Landmark]) -> Floats:
    """The joint covariance under those names: X S moves by Ad(S^-1) of what X moves by."""
    J = np.zeros_like(b.covariance)
    for k, (before, now) in enumerate(zip(b.landmarks, named, strict=True)):
        rows = slice(6 * k, 6 * k + 6)
        J[rows, rows] = adjoint(inverse(now.T_world_target) @ before.T_world_target)
    return J @ b.covariance @ J.T


def _measured(measured: Map, chains: Sequence[Chain]) -> JointPoses:
    """A map as a joint measurement of poses, each a chain."""
    poses = np.array([landmark.T_world_target for landmark in measured.landmarks])
    return JointPoses(Chains(chains), poses, sqrt_information(measured.covariance))


def _landmarks(a: Map, b: Map, poses: Mapping[str, Floats], joint: Floats) -> tuple[Landmark, ...]:
    merged = []
    for k, (name, T) in enumerate(poses.items()):
        found = [landmark for landmark in (*a.landmarks, *b.landmarks) if landmark.id == name]
        block = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        observations = sum(landmark.observations for landmark in found)
        merged.append(Landmark(name, found[0].target, T, block, observations))
    return tuple(merged)
