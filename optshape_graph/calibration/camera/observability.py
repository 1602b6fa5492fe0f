"""Which directions of an extrinsic the views determine badly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.uncertainty import Uncertainty
from optshape_graph.errors import UnobservableError
from optshape_graph.se3 import adjoint

UNOBSERVABLE = 0.3
"""Standard deviation beyond which a direction counts as open: metres, or rad times the targets' distance."""

PARALLEL_DEG = 10.0
"""Spread of the targets' normals under which the views count as parallel."""

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Direction:
    """A principal direction of an extrinsic's uncertainty, in one sensor's frame, about the middle of the targets.

    Attributes:
        text: what it is, in words.
        sigma_m: standard deviation, metres; of a rotation, at the targets' distance.
    """

    text: str
    sigma_m: float


def principal_directions(covariance: Floats, centre: Floats, frame: str = "LiDAR") -> list[Direction]:
    """Split the covariance of T_camera_lidar, or of any T_a_b, in principal directions, the worst first.

    Rotation and translation are taken about the middle of the targets, where they are nearly independent, and a
    rotation counts by how far it moves what is one targets' distance away.

    Args:
        covariance: (6, 6) of the right perturbation (LiDAR frame, or b's), rotation first.
        centre: (3,) middle of the targets, metres, in that frame.
        frame: what words call that frame.
    """
    distance = float(np.linalg.norm(centre))
    to_middle = np.eye(4)
    to_middle[:3, 3] = -centre
    J = np.diag([distance] * 3 + [1.0] * 3) @ adjoint(to_middle)
    values, vectors = np.linalg.eigh(J @ covariance @ J.T)
    return [
        Direction(_words(vector, float(np.sqrt(max(value, 0.0))), distance, frame), float(np.sqrt(max(value, 0.0))))
        for value, vector in zip(values[::-1], vectors.T[::-1], strict=True)
    ]


def _words(vector: Floats, sigma: float, distance: float, frame: str = "LiDAR") -> str:
    turn, shift = vector[:3], vector[3:]
    if turn @ turn > shift @ shift:
        axis = turn / np.linalg.norm(turn)
        return f"rotation about {_axis(axis, frame)} through the targets, {np.degrees(sigma / distance):.3f} deg"
    return f"translation along {_axis(shift / np.linalg.norm(shift), frame)}, {1e3 * sigma:.1f} mm"


def _axis(axis: Floats, frame: str = "LiDAR") -> str:
    k = int(np.abs(axis).argmax())
    if abs(axis[k]) > 0.95:
        return f"{frame} {AXES[k]}"
    x, y, z = axis * np.sign(axis[k])
    return f"{frame} ({x:.2f}, {y:.2f}, {z:.2f})"


def check_observable(uncertainty: Uncertainty, centre: Floats) -> None:
    """Raise unless the graph determines every sensor's pose.

    Args:
        uncertainty: of the graph at its minimum.
        centre: (3,) middle of the targets, metres, LiDAR frame.

    Raises:
        UnobservableError: names the directions that it leaves open.
    """
    distance = float(np.linalg.norm(centre))
    sensors = [name for kind, name in uncertainty.rows if kind == "pose"]
    blocks = [uncertainty.rows["pose", name] for name in sensors]
    # Perturbations in metres, about the middle of the targets: x = back @ metres.
    back = np.eye(len(uncertainty.information))
    to_middle = np.eye(4)
    to_middle[:3, 3] = -centre
    for block in blocks:
        back[block, block] = np.linalg.inv(np.diag([distance] * 3 + [1.0] * 3) @ adjoint(to_middle))
    values, vectors = np.linalg.eigh(back.T @ uncertainty.information @ back)
    names = []
    for value, vector in zip(values, vectors.T, strict=True):
        sigma = 1 / np.sqrt(max(value, 1e-12))
        k = int(np.argmax([np.linalg.norm(vector[block]) for block in blocks]))
        if sigma > UNOBSERVABLE and np.linalg.norm(vector[blocks[k]]) > 0.5:
            names.append(f"'{sensors[k]}': {_words(vector[blocks[k]], float(sigma), distance)}")
    if names:
        raise UnobservableError(f"the views leave open: {'; '.join(names)}", tuple(names))


def parallel_planes(normals: Floats) -> str:
    """Say in which directions unit plane normals (V, 3), LiDAR frame, hardly vary; empty: they vary in all.

    Planes measure translation along their normals only, so what they leave open rests on the targets' edges.
    """
    mean = normals.mean(axis=0)
    mean /= np.linalg.norm(mean)
    across = normals - np.outer(normals @ mean, mean)
    _, widths, axes = np.linalg.svd(across, full_matrices=False)
    spread = np.degrees(np.arcsin(np.clip(widths / np.sqrt(len(normals)), 0.0, 1.0)))
    if len(spread) > 1 and spread[1] >= PARALLEL_DEG:
        return ""
    if spread[0] < PARALLEL_DEG:
        x, y, z = mean
        return (
            f"the target's planes are nearly parallel (their normals spread by {spread[0]:.1f} deg about "
            f"({x:.2f}, {y:.2f}, {z:.2f})): the translations along the plane and the rotation about that normal rest "
            f"on the target's edges alone; add views with the target tilted otherwise"
        )
    axis = np.cross(mean, axes[0])
    return (
        f"the target was turned about one axis only (beside it, its normals spread by "
        f"{spread[1] if len(spread) > 1 else 0.0:.1f} deg): the translation along {_axis(axis)} rests on the target's "
        f"edges alone; add views with the target tilted about another axis"
    )
