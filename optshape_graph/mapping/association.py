"""Which sighting is of which landmark: gating by Mahalanobis distance, and joint compatibility.

A pairing of a sighting with a landmark predicts T_target_lidar = T_world_target^-1 T_world_lidar. What was measured
differs by e = Log(H_hat^-1 H), whose covariance is that of the measurement and of both poses, which are correlated:
their common drift does not make a landmark harder to recognise. All pairings of one scan are judged together (Neira and
Tardos, Data association in stochastic mapping using the joint compatibility test, IEEE TRA 2001).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.stats import chi2

from optshape_graph._arrays import Floats, Ints
from optshape_graph.factors.summary import Summary, linearise
from optshape_graph.mapping.map import Map
from optshape_graph.mapping.track import Sighting
from optshape_graph.se3 import adjoint, difference, inverse

CONFIDENCE = 0.999
"""Share of the right pairings that pass the gate, if covariances are right."""

SAME_PLACE = 0.3
"""Tangent distance, rad and metres, within which two poses count as one."""

MOST_TRIED = 2000
"""Number of combinations of pairings after which the search for the best one ends with what it has."""


@lru_cache
def gate(dof: int) -> float:
    """Return the squared Mahalanobis distance that a share of CONFIDENCE of the right pairings stays below."""
    return float(chi2.ppf(CONFIDENCE, dof))


@dataclass(frozen=True, eq=False, slots=True)
class Pairing:
    """A sighting taken for a landmark, in one of its hypotheses.

    Attributes:
        sighting: which of the scan's sightings.
        landmark: name of the landmark.
        hypothesis: which of the sighting's hypotheses.
        T_target_lidar: (4, 4) predicted pose H, where the measurement is summarised.
        summary: of the measurement there.
        residual: (6,) of the predicted pose, whitened by the measurement alone.
        jacobian: (6, 12) derivative of the residual by the landmark's pose, then the LiDAR's, right perturbations.
        distance: squared Mahalanobis distance, poses' covariance included; infinite before that is known.
        likelihood: twice the negative log likelihood: the distance and the log determinant of its covariance.
    """

    sighting: int
    landmark: str
    hypothesis: int
    T_target_lidar: Floats
    summary: Summary
    residual: Floats
    jacobian: Floats
    distance: float = np.inf
    likelihood: float = np.inf


def predictions(
    sightings: Sequence[Sighting], possible: Sequence[Mapping[str, Floats]], T_world_lidar: Floats
) -> list[Pairing]:
    """Return every pairing of sightings with the landmarks that they may be of, under each hypothesis.

    Args:
        sightings: of one scan.
        possible: for each of them, T_world_target (4, 4) by the landmark's name.
        T_world_lidar: (4, 4) predicted.
    """
    tried = [
        (k, name, h, measurement, T)
        for k, (sighting, landmarks) in enumerate(zip(sightings, possible, strict=True))
        for name, T in landmarks.items()
        for h, measurement in enumerate(sighting.hypotheses)
    ]
    if not tried:
        return []
    H = inverse(np.array([one[4] for one in tried])) @ T_world_lidar
    model = linearise([one[3] for one in tried], H)
    # The target's pose moves H by -Ad(H^-1) xi, the LiDAR's by xi.
    jacobians = np.concatenate([-model.R @ adjoint(inverse(H)), model.R], axis=2)
    summaries, residuals = model.summaries(), model.residuals
    return [
        Pairing(k, name, h, H[n], summaries[n], residuals[n], jacobians[n])
        for n, (k, name, h, _, _) in enumerate(tried)
    ]


def distance(residual: Floats, jacobian: Floats, covariance: Floats) -> tuple[float, float]:
    """Return the squared Mahalanobis distance of a whitened residual, and the log determinant of its covariance.

    Args:
        residual: (m,) whitened by the measurement alone.
        jacobian: (m, d) its derivative by the poses, right perturbations, rotation (rad) first, then metres.
        covariance: (d, d) matrix of the poses.
    """
    S = np.linalg.cholesky(np.eye(len(residual)) + jacobian @ covariance @ jacobian.T)
    white = np.linalg.solve(S, residual)
    return float(white @ white), 2.0 * float(np.log(np.diag(S)).sum())


def plain(pairings: Sequence[Pairing], n_sightings: int, motion: Floats) -> list[Pairing | None] | None:
    """Return the pairing of each sighting if there is one at most and the last motion's uncertainty alone explains it.

    The poses' own covariance can only make the distance smaller, so such a pairing passes the gate whatever that is,
    and it need not be asked for. None: it must be.

    Args:
        pairings: all of a scan.
        n_sightings: their number.
        motion: (6, 6) covariance of the odometry since the pose before.
    """
    for one in ("landmark", "sighting"):
        if len({getattr(pairing, one) for pairing in pairings}) < len(pairings):
            return None
    residual = np.array([pairing.residual for pairing in pairings])
    J = np.array([pairing.jacobian[:, 6:] for pairing in pairings])
    S = J @ motion @ J.swapaxes(1, 2)
    S[:, range(6), range(6)] += 1.0
    d2 = (residual * np.linalg.solve(S, residual[..., None])[..., 0]).sum(axis=1)
    if d2.max() > gate(6):
        return None
    of_sighting = {pairing.sighting: pairing for pairing in pairings}
    return [of_sighting.get(k) for k in range(n_sightings)]


def gated(pairings: Sequence[Pairing], covariance: Floats, order: Mapping[str, int]) -> list[Pairing]:
    """Return the pairings that pass the gate alone, each sighting with each landmark in its best hypothesis.

    Args:
        pairings: all of a scan.
        covariance: (d, d) joint covariance of all landmarks in question and the LiDAR's pose, which is last.
        order: position of each landmark's block in `covariance`.
    """
    best: dict[tuple[int, str], Pairing] = {}
    for pairing in pairings:
        rows = block(order[pairing.landmark], len(covariance))
        d2, log_det = distance(pairing.residual, pairing.jacobian, covariance[np.ix_(rows, rows)])
        rival = best.get((pairing.sighting, pairing.landmark))
        if d2 < gate(6) and (rival is None or d2 < rival.distance):
            best[pairing.sighting, pairing.landmark] = replace(pairing, distance=d2, likelihood=d2 + log_det)
    return sorted(best.values(), key=lambda pairing: pairing.likelihood)


def block(position: int, size: int) -> Ints:
    """Return the rows (12,) of a landmark and of the LiDAR's pose, last, in a joint covariance of `size` rows."""
    return np.concatenate([np.arange(6 * position, 6 * position + 6), np.arange(size - 6, size)])


def associate(
    pairings: Sequence[Pairing], n_sightings: int, covariance: Floats, order: Mapping[str, int]
) -> list[Pairing | None]:
    """Choose a pairing for each sighting of a scan: as many as are jointly compatible, and of those the likeliest.

    No two sightings are of one landmark.

    Args:
        pairings: that have passed the gate alone, the likeliest first.
        n_sightings: number of sightings of the scan.
        covariance: (d, d) joint covariance of the landmarks and the LiDAR's pose, which is last.
        order: position of each landmark's block in `covariance`.
    """
    candidates = [[p for p in pairings if p.sighting == k] for k in range(n_sightings)]
    best: list[Pairing | None] = [None] * n_sightings
    best_rank = (0, np.inf)
    tried = 0

    def search(chosen: list[Pairing | None], likelihood: float) -> None:
        nonlocal best, best_rank, tried
        paired = sum(pairing is not None for pairing in chosen)
        left = len(candidates) - len(chosen)
        if paired + left < -best_rank[0] or tried > MOST_TRIED:
            return
        if not left:
            best_rank, best = min((best_rank, best), ((-paired, likelihood), chosen), key=lambda ranked: ranked[0])
            return
        taken = {pairing.landmark for pairing in chosen if pairing is not None}
        for pairing in candidates[len(chosen)]:
            if pairing.landmark in taken:
                continue
            tried += 1
            compatible, joint = _joint([*chosen, pairing], covariance, order)
            if compatible:
                search([*chosen, pairing], joint)
        search([*chosen, None], likelihood)

    search([], 0.0)
    return best


def _joint(chosen: Sequence[Pairing | None], covariance: Floats, order: Mapping[str, int]) -> tuple[bool, float]:
    """Say whether pairings are compatible all together, and how likely they are."""
    pairs = [pairing for pairing in chosen if pairing is not None]
    if len(pairs) == 1:
        return True, pairs[0].likelihood  # it has passed the gate alone
    J = np.zeros((6 * len(pairs), len(covariance)))
    for k, pairing in enumerate(pairs):
        J[6 * k : 6 * k + 6, block(order[pairing.landmark], len(covariance))] = pairing.jacobian
    d2, log_det = distance(np.concatenate([pairing.residual for pairing in pairs]), J, covariance)
    return d2 < gate(6 * len(pairs)), d2 + log_det


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
    if any(entry[0] == count and float(np.linalg.norm(difference(T, entry[2]))) > SAME_PLACE for entry in found[1:]):
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
