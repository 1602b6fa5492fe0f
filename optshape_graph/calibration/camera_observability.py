"""Which directions of an extrinsic the views determine badly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.uncertainty import Uncertainty
from optshape_graph.errors import UnobservableError
from optshape_graph.factors.se3 import adjoint

UNOBSERVABLE = 0.3
"""Standard deviation beyond which a direction counts as open: metres, or rad times the targets' distance."""

PARALLEL_DEG = 10.0
"""Spread of the targets' normals under which the views count as parallel."""

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Direction:
    """A principal direction of an extrinsic's uncertainty, LiDAR frame, about the middle of the targets.

    Attributes:
        text: what it is, in words.
        sigma_m: standard deviation, metres; of a rotation, at the targets' distance.
    """

    text: str
    sigma_m: float


def principal_directions(covariance: Floats, centre: Floats) -> list[Direction]:
    """Split the covariance of T_camera_lidar in principal directions, the worst first.

    Rotation and translation are taken about the middle of the targets, where they are nearly independent, and a
    rotation counts by how far it moves what is one targets' distance away.

    Args:
        covariance: (6, 6) of the right perturbation (LiDAR frame), rotation first.
        centre: (3,) middle of the targets, metres, LiDAR frame.
    """
    distance = float(np.linalg.norm(centre))
    to_middle = np.eye(4)
    to_middle[:3, 3] = -centre
    J = np.diag([distance] * 3 + [1.0] * 3) @ adjoint(to_middle)
    values, vectors = np.linalg.eigh(J @ covariance @ J.T)
    return [
        Direction(_words(vector, float(np.sqrt(max(value, 0.0))), distance), float(np.sqrt(max(value, 0.0))))
        for value, vector in zip(values[::-1], vectors.T[::-1], strict=True)
    ]


def _words(vector: Floats, sigma: float, distance: float) -> str:
    turn, shift = vector[:3], vector[3:]
    if turn @ turn > shift @ shift:
        axis = turn / np.linalg.norm(turn)
        return f"rotation about {_axis(axis)} through the targets, {np.degrees(sigma / distance):.3f} deg"
    return f"translation along {_axis(shift / np.linalg.norm(shift))}, {1e3 * sigma:.1f} mm"


def _axis(axis: Floats) -> str:
    k = int(np.abs(axis).argmax())
    if abs(axis[k]) > 0.95:
        return f"LiDAR {AXES[k]}"
    x, y, z = axis * np.sign(axis[k])
    return f"LiDAR ({x:.2f}, {y:.2f}, {z:.2f})"


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


def normal_spread(normals: Floats) -> tuple[float, Floats]:
    """Return the spread of plane normals (V, 3) in their second widest direction, rad, and their mean (3,)."""
    mean = normals.mean(axis=0)
    mean /= np.linalg.norm(mean)
    across = normals - np.outer(normals @ mean, mean)
    widths = np.linalg.svd(across, compute_uv=False) / np.sqrt(len(normals))
    return float(np.arcsin(min(1.0, widths[1] if len(widths) > 1 else 0.0))), mean
