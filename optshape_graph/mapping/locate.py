"""Where a robot is in a map it has not been in yet: from what it sees of the map's landmarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.mapping.association import Pairing, associate, gated, predictions
from optshape_graph.mapping.map import Map
from optshape_graph.mapping.track import Sighting
from optshape_graph.se3 import adjoint, difference, inverse

SAME_PLACE = 0.3
"""Tangent distance, rad and metres, within which two poses count as one."""


def locate(sightings: Sequence[Sighting], known: Map) -> tuple[Floats, list[Pairing | None]] | None:
    """Find a pose from sightings of known landmarks.

    Every sighting is taken for every landmark that it may be of, under each of its hypotheses; the pose that follows is
    judged by how many of the other sightings it explains, and how well.

    Args:
        sightings: what was seen from one pose.
        known: the map.

    Returns:
        T_world_lidar (4, 4) and the pairing of each sighting; None where no landmark was recognised, or where another
        pose explains as many sightings.
    """
    order = {landmark.id: k for k, landmark in enumerate(known.landmarks)}
    poses = {landmark.id: landmark.T_world_target for landmark in known.landmarks}
    possible = [
        {
            landmark.id: landmark.T_world_target
            for landmark in known.landmarks
            if (sighting.landmark or landmark.id) == landmark.id and landmark.target.name == sighting.target.name
        }
        for sighting in sightings
    ]
    found: list[tuple[int, float, Floats, list[Pairing | None]]] = []
    for k, sighting in enumerate(sightings):
        if not sighting.determined:
            continue
        for name in possible[k]:
            for hypothesis, summary in enumerate(sighting.summaries):
                T = poses[name] @ summary.T_target_lidar
                joint = _with_pose(known.covariance, order[name], summary.T_target_lidar, summary.sqrt_information)
                chosen = _others(sightings, possible, k, name, T, joint, order)
                H = summary.T_target_lidar
                chosen[k] = Pairing(k, name, hypothesis, H, summary, np.zeros(6), np.zeros((6, 12)), 0.0, 0.0)
                ranked = [p for p in chosen if p is not None]
                found.append((len(ranked), sum(p.likelihood for p in ranked), T, chosen))
    if not found:
        return None
    found.sort(key=lambda entry: (-entry[0], entry[1]))
    count, _, T, chosen = found[0]
    if any(entry[0] == count and _apart(T, entry[2]) > SAME_PLACE for entry in found[1:]):
        return None
    return T, chosen


def _others(
    sightings: Sequence[Sighting],
    possible: Sequence[Mapping[str, Floats]],
    k: int,
    name: str,
    T_world_lidar: Floats,
    covariance: Floats,
    order: Mapping[str, int],
) -> list[Pairing | None]:
    """Pair the sightings other than k, which is taken for the landmark of a name already."""
    left = [
        {} if i == k else {other: T for other, T in landmarks.items() if other != name}
        for i, landmarks in enumerate(possible)
    ]
    pairings = gated(predictions(sightings, left, T_world_lidar), covariance, order)
    return associate(pairings, len(sightings), covariance, order)


def _with_pose(covariance: Floats, position: int, T_target_lidar: Floats, sqrt_information: Floats) -> Floats:
    """Joint covariance of landmarks and T_world_lidar = T_world_target H: it moves by Ad(H^-1) xi + the error of H."""
    n = len(covariance)
    J = np.zeros((n + 6, n))
    J[:n] = np.eye(n)
    J[n:, 6 * position : 6 * position + 6] = adjoint(inverse(T_target_lidar))
    joint = J @ covariance @ J.T
    root = np.linalg.inv(sqrt_information)
    joint[n:, n:] += root @ root.T
    return joint


def _apart(a: Floats, b: Floats) -> float:
    return float(np.linalg.norm(difference(a, b)))
