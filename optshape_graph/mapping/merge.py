"""Two maps with landmarks in common become one, in the frame of the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.mapping.map import Landmark, Map
from optshape_graph.mapping.priors import sqrt_information
from optshape_graph.se3 import adjoint, difference, exp, inverse, inverse_covariance, inverse_right_jacobian

MAX_ITERATIONS = 30
"""Gauss-Newton steps at most."""

CONVERGED = 1e-9
"""Largest component of a step, rad or metres, with which it ends."""


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
    poses = {landmark.id: T_a_b @ landmark.T_world_target for landmark in b.landmarks}
    poses |= {landmark.id: landmark.T_world_target for landmark in a.landmarks}
    R_a, R_b = sqrt_information(a.covariance), sqrt_information(b.covariance)
    size = 6 * len(names)
    for _ in range(MAX_ITERATIONS):
        J_a, e_a = _rows(a, names, poses, np.eye(4))
        J_b, e_b = _rows(b, names, poses, T_a_b)
        # The first map's frame is the world: only the second one's moves.
        J = np.vstack([R_a @ J_a[:, :size] @ np.eye(size, size + 6), R_b @ J_b])
        step = -np.linalg.lstsq(J, np.concatenate([R_a @ e_a, R_b @ e_b]), rcond=None)[0]
        poses = {name: poses[name] @ exp(step[6 * k : 6 * k + 6]) for k, name in enumerate(names)}
        T_a_b = T_a_b @ exp(step[size:])
        if np.abs(step).max() < CONVERGED:
            break
    else:
        raise EstimationError(f"merging the maps did not converge within {MAX_ITERATIONS} iterations")
    joint = np.linalg.inv(J.T @ J)[:size, :size]
    joint = 0.5 * (joint + joint.T)
    moved = {name: Trajectory(T_a_b @ t.poses, t.stamps, t.name) for name, t in b.trajectories.items()}
    return Map(_landmarks(a, b, names, poses, joint), joint, {**a.trajectories, **moved})


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


def _rows(measured: Map, names: list[str], poses: dict[str, Floats], T_a_m: Floats) -> tuple[Floats, Floats]:
    """Residuals Log(M_hat^-1 T_a_m^-1 X) of a map's landmarks, and their derivatives by all landmarks and T_a_m."""
    J = np.zeros((6 * len(measured.landmarks), 6 * len(names) + 6))
    e = np.zeros(len(J))
    for i, landmark in enumerate(measured.landmarks):
        seen = inverse(T_a_m) @ poses[landmark.id]
        xi = difference(landmark.T_world_target, seen)
        rows, k = slice(6 * i, 6 * i + 6), names.index(landmark.id)
        e[rows] = xi
        J[rows, 6 * k : 6 * k + 6] = inverse_right_jacobian(xi)
        J[rows, -6:] = -inverse_right_jacobian(xi) @ adjoint(inverse(seen))
    return J, e


def _landmarks(a: Map, b: Map, names: list[str], poses: dict[str, Floats], joint: Floats) -> tuple[Landmark, ...]:
    merged = []
    for k, name in enumerate(names):
        found = [landmark for landmark in (*a.landmarks, *b.landmarks) if landmark.id == name]
        block = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        observations = sum(landmark.observations for landmark in found)
        merged.append(Landmark(name, found[0].target, poses[name], block, observations))
    return tuple(merged)
