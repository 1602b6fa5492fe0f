"""How well a graph knows some variables, when measurements share errors that it takes for independent."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Value


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(Value):
    """How well the sensors' places and range biases are known at a minimum of the graph.

    Attributes:
        information: (m, m) matrix, everything else marginalised, of errors that are independent from scan to scan; in
            units of the rows: rad and metres.
        covariance: (m, m) its inverse matrix, with what common ring biases change.
        rows: by variable: ("pose", sensor), the right perturbation of T_base_sensor, rotation first; ("range_bias",
            lidar).
    """

    information: Floats
    covariance: Floats
    rows: Mapping[tuple[str, str], slice]


def uncertainty_of(
    linear: gtsam.GaussianFactorGraph,
    values: gtsam.Values,
    kept: Sequence[int],
    rows: Mapping[tuple[str, str], slice],
    shifts: Mapping[int, tuple[Sequence[Hashable], Floats]],
) -> Uncertainty:
    """Marginalise, and allow for errors that the graph counts once for each scan though the scans share them.

    With G_k J_k the response of the kept variables to the shared errors of unit covariance by way of scan k, what the
    graph counts is sum G_k J_k (G_k J_k)^T, and what it should count is F F^T with F = sum G_k J_k over all scans.

    Args:
        linear: the graph at its minimum.
        values: there.
        kept: those to keep.
        rows: of the result.
        shifts: by the key of an eliminated variable, the N shared errors that move it, and how a unit of each changes
            the right-hand side of its normal equations (6, N).
    """
    ordering = gtsam.Ordering()
    everything = list(values.keys())
    ordered = [key for key in everything if key not in kept] + list(kept)
    for key in ordered:
        ordering.push_back(key)
    hessian, _ = linear.hessian(ordering)
    m = max(block.stop for block in rows.values())
    other, cross, own = hessian[:-m, :-m], hessian[:-m, -m:], hessian[-m:, -m:]
    # Radians, metres and pixels differ by orders of magnitude: scaled to a unit diagonal first.
    scale = 1 / np.sqrt(np.maximum(np.diag(other), 1e-300))[:, None]
    eliminated = scale * np.linalg.lstsq(other * scale * scale.T, scale * cross, rcond=1e-13)[0]
    information = own - cross.T @ eliminated
    covariance = np.linalg.pinv(information, hermitian=True)

    zeros = values.zeroVectors()
    ends = np.cumsum([len(zeros.at(key)) for key in ordered])
    end = dict(zip(ordered, ends.tolist(), strict=True))
    counted, common = np.zeros((m, m)), dict[Hashable, Floats]()
    for key, (errors, shift) in shifts.items():
        response = -covariance @ eliminated[end[key] - 6 : end[key]].T @ shift
        counted += response @ response.T
        for error, column in zip(errors, response.T, strict=True):
            common[error] = common.get(error, np.zeros(m)) + column
    shared = sum((np.outer(F, F) for F in common.values()), np.zeros((m, m)))
    return Uncertainty(information, covariance - counted + shared, rows)
