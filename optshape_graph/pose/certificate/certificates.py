"""The certificate of a pose: whether any other costs less."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError
from optshape_graph.factors.measurement import TemplateMeasurement
from optshape_graph.pose.certificate.multipliers import closed_form_bounds
from optshape_graph.pose.certificate.relaxation import Backend, eliminate_translation, lower_bound

NOT_TIGHT = "not certified: the bound on other poses of these matches is not tight"
"""Why a pose that is ok has no certificate."""


@dataclass(frozen=True)
class Certificate:
    """How far a pose can be from the best one, for the association and the weights it was estimated with.

    Attributes:
        certified: the pose is the global minimum among those with the sensor on the -x side: its gap is small enough,
            by default (0.1 mm)^2 a residual, and the second eigenvalue says that there is no other.
        gap_m2: (cost of the pose - lower bound on the cost of every such pose) / number of residual rows, weights
            normalised to mean 1, square metres.
        second_eigenvalue: second smallest eigenvalue of the dual's matrix, normalised alike, square metres.
    """

    certified: bool
    gap_m2: float
    second_eigenvalue: float


def certify(
    measurement: TemplateMeasurement,
    T_target_lidar: Floats,
    total_weight: float,
    backend: Backend = "closed-form",
    largest_gap: float = 1e-4,
) -> Certificate:
    """Certify a pose against every other one with the sensor on the -x side; one from behind, against all.

    Args:
        measurement: the whitened rows.
        T_target_lidar: (4, 4) the pose in question.
        total_weight: sum over rows of 1 / sigma^2, 1/m2: the gap is in whitened units before it is divided by it.
        backend: what finds the multipliers of the dual.
        largest_gap: metres a residual: root of the gap up to which the pose is certified.

    Raises:
        InputError: a backend that does not exist.
        EstimationError: the measurement constrains no rotation at all.
    """
    (found,) = certify_all([measurement], T_target_lidar[None], [total_weight], backend, [largest_gap])
    if isinstance(found, EstimationError):
        raise found
    return found


def certify_all(
    measurements: Sequence[TemplateMeasurement],
    T_target_lidar: Floats,
    total_weights: Sequence[float],
    backend: Backend,
    largest_gaps: Sequence[float],
) -> list[Certificate | EstimationError]:
    """Certify the poses (B, 4, 4) of B measurements at once, see `certify`; an error is the result of its own alone."""
    Q = np.stack([one.quadratic() for one in measurements])
    bounds, second = np.full(len(Q), -np.inf), np.zeros(len(Q))
    if backend == "closed-form":
        bounds, second = closed_form_bounds(eliminate_translation(Q)[0], T_target_lidar[:, :3, :3])

    def judged(k: int, bound: float, second_eigenvalue: float) -> Certificate:
        gap = max(0.0, 2.0 * measurements[k].error(T_target_lidar[k]) - bound) / total_weights[k]
        second = second_eigenvalue / total_weights[k]
        return Certificate(bool(gap <= largest_gaps[k] ** 2 and second > 0), gap, second)

    def certificate(k: int) -> Certificate:
        found = judged(k, float(bounds[k]), float(second[k]))
        if found.certified:
            return found
        dual = lower_bound(Q[k], backend)
        found = judged(k, dual.bound, dual.second_eigenvalue)
        if found.certified or T_target_lidar[k, 0, 3] >= 0:
            return found
        # A bound on all poses holds for those in front too, so the better of the two counts.
        dual = lower_bound(Q[k], backend, T_target_lidar[k, :3, :3])
        in_front = judged(k, dual.bound, dual.second_eigenvalue)
        return in_front if in_front.gap_m2 < found.gap_m2 else found

    results: list[Certificate | EstimationError] = []
    for k in range(len(Q)):
        try:
            results.append(certificate(k))
        except EstimationError as error:
            results.append(error)
    return results
