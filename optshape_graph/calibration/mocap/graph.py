"""The motion-capture graph: scans and markers of a session in one least-squares problem.

E     T_lidar_mocap
M_k   the marker near vertex k, target frame: a prior at the vertex, which alone tells a displacement of all markers
from one of the frame
H_i   T_target_lidar of scan i: its returns constrain it by the exact template factor, its markers by M and E
B     errors of the LiDAR's rings, which its scans share
S     scale of the motion capture, where it is estimated
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, H, M, S

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.mocap.comparison import MocapScan
from optshape_graph.errors import EstimationError
from optshape_graph.factors import CheckedFactor
from optshape_graph.graph import SharedErrors, Templates
from optshape_graph.graph import solve as minimise
from optshape_graph.se3 import apply, difference, inverse, skew

SCALE_PRIOR = 0.05
"""Standard deviation of the motion capture's scale about 1, where it is estimated."""


@dataclass(frozen=True)
class MarkerModel:
    """What is assumed of the markers.

    Attributes:
        noise: standard deviation of a marker coordinate, metres.
        layout_prior: standard deviation of a marker's place about its vertex along each axis, metres.
        with_scale: whether the scale of the motion capture is estimated.
    """

    noise: float = 1e-3
    layout_prior: float = 0.03
    with_scale: bool = False


@dataclass(frozen=True, eq=False, repr=False)
class Solution(Value):
    """The minimum of the graph.

    Attributes:
        T_lidar_mocap: (4, 4).
        covariance: (6, 6) of its right perturbation, rotation first.
        layout: (n, 3) markers, target frame, metres.
        layout_covariance: (n, 3, 3) of each, square metres.
        scale: of the motion capture.
        scale_sigma: its standard deviation; 0 where it was not estimated.
        T_target_lidar: (4, 4) of each scan, by its number.
        covariance_target_lidar: (6, 6) of their right perturbations.
    """

    T_lidar_mocap: Floats
    covariance: Floats
    layout: Floats
    layout_covariance: Floats
    scale: float
    scale_sigma: float
    T_target_lidar: dict[int, Floats]
    covariance_target_lidar: dict[int, Floats]


@dataclass(frozen=True, eq=False, repr=False)
class Innovation(Value):
    """A scan's estimate against what its markers say by the returns of the other scans.

    Attributes:
        chi_square: squared Mahalanobis distance, with 6 degrees of freedom were all covariances right.
        T_lidar_target: (4, 4) that the others predict.
        rms: root mean square distance of the vertices, metres.
    """

    chi_square: float
    T_lidar_target: Floats
    rms: float


def solve(
    scans: Sequence[MocapScan],
    T_lidar_mocap: Floats,
    model: MarkerModel,
    used: Collection[int],
    predicted: Collection[int] = (),
) -> Solution:
    """Minimise over some of the scans.

    Args:
        scans: all of them, of one target.
        T_lidar_mocap: (4, 4) where to start.
        model: of the markers.
        used: numbers of the scans whose returns and markers take part.
        predicted: numbers of the scans whose markers alone take part, so that they predict the target's pose.

    Raises:
        EstimationError: the minimum is not found.
        UnobservableError: the scans leave T_lidar_mocap open; it says in which directions.
    """
    target, factors, values = scans[0].estimate.target, gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(E(0), gtsam.Pose3(T_lidar_mocap))
    near = gtsam.noiseModel.Isotropic.Sigma(3, model.layout_prior)
    for k, vertex in enumerate(target.vertices):
        values.insert(M(k), vertex)
        factors.push_back(gtsam.PriorFactorPoint3(M(k), vertex, near))
    if model.with_scale:
        values.insert(S(0), 1.0)
        factors.push_back(gtsam.PriorFactorDouble(S(0), 1.0, gtsam.noiseModel.Isotropic.Sigma(1, SCALE_PRIOR)))
    everyone = sorted({*used, *predicted})
    for i in everyone:
        values.insert(H(i), gtsam.Pose3(scans[i].estimate.T_target_lidar))
        factors.push_back(marker_factor(scans[i].markers, i, model.noise, model.with_scale))
    shared = {i: one for i in used if (one := scans[i].estimate.of_sensor) is not None}
    alone = [i for i in used if i not in shared]
    returns = SharedErrors.of(list(shared.values()), [[H(i)] for i in shared], [B(0)] * len(shared))
    returns.insert(values)
    others = Templates.of([scans[i].estimate.measurement for i in alone], [[H(i)] for i in alone])
    found = minimise(values, [returns, others], factors, names={E(0): "T_lidar_mocap", B(0): "the rings' errors"})
    if not found.converged:
        raise EstimationError("the motion-capture graph did not converge")
    return Solution(
        T_lidar_mocap=found.pose(E(0)),
        covariance=found.covariance([E(0)]),
        layout=np.array([found.values.atPoint3(M(k)) for k in range(len(target))]),
        layout_covariance=np.array([found.covariance([M(k)]) for k in range(len(target))]),
        scale=found.values.atDouble(S(0)) if model.with_scale else 1.0,
        scale_sigma=float(np.sqrt(found.covariance([S(0)])[0, 0])) if model.with_scale else 0.0,
        T_target_lidar={i: found.pose(H(i)) for i in everyone},
        covariance_target_lidar={i: found.covariance([H(i)]) for i in everyone},
    )


def innovations(
    scans: Sequence[MocapScan], T_lidar_mocap: Floats, model: MarkerModel, used: Collection[int]
) -> dict[int, Innovation]:
    """Compare every scan, by its number, with the used ones but itself.

    Args:
        scans: all of them.
        T_lidar_mocap: (4, 4) where to start.
        model: of the markers.
        used: numbers of the scans that are believed.

    Raises:
        EstimationError: see `solve`.
    """
    found = {}
    for i, scan in enumerate(scans):
        others = [k for k in used if k != i]
        if not others:
            continue
        estimate, solution = scan.estimate, solve(scans, T_lidar_mocap, model, others, [i])
        predicted = solution.T_target_lidar[i]
        x = difference(predicted, estimate.T_target_lidar)
        total = solution.covariance_target_lidar[i] + estimate.covariance_target_lidar
        T = inverse(predicted)
        off = apply(T, estimate.target.vertices) - estimate.vertices
        rms = float(np.sqrt((off**2).sum(axis=1).mean()))
        found[i] = Innovation(float(x @ np.linalg.solve(total, x)), T, rms)
    return found


def marker_factor(markers: Floats, i: int, sigma: float, with_scale: bool, frame: int = 0) -> gtsam.CustomFactor:
    """Return the factor of one scan's markers: H_i T_lidar_mocap (s q_k) - m_k for every marker that was seen.

    Args:
        markers: (n, 3) q_k, metres, motion-capture frame, NaN where not seen.
        i: the scan's index, of the key of T_target_lidar.
        sigma: standard deviation of a coordinate, metres.
        with_scale: whether s is a variable.
        frame: number of the motion-capture frame, of the key of T_lidar_mocap.
    """
    seen = np.flatnonzero(np.isfinite(markers).all(axis=1))
    keys = [H(i), E(frame), *(M(int(k)) for k in seen), *([S(0)] if with_scale else [])]
    q = markers[seen]

    def evaluate(values: gtsam.Values) -> tuple[Floats, list[Floats]]:
        scale = values.atDouble(S(0)) if with_scale else 1.0
        T_target_lidar, T_lidar_mocap = values.atPose3(H(i)).matrix(), values.atPose3(E(frame)).matrix()
        R_t, R_l = T_target_lidar[:3, :3], T_lidar_mocap[:3, :3]
        in_lidar = scale * q @ R_l.T + T_lidar_mocap[:3, 3]
        in_target = in_lidar @ R_t.T + T_target_lidar[:3, 3]
        layout = np.array([values.atPoint3(M(int(k))) for k in seen])
        by_pose = np.vstack([np.hstack([-R_t @ skew(p), R_t]) for p in in_lidar])
        by_frame = np.vstack([R_t @ np.hstack([-R_l @ skew(scale * p), R_l]) for p in q])
        by_layout = [-np.eye(3 * len(seen))[:, 3 * k : 3 * k + 3] for k in range(len(seen))]
        by_scale = [(q @ R_l.T @ R_t.T).reshape(-1, 1)] if with_scale else []
        jacobians = [by_pose, by_frame, *by_layout, *by_scale]
        return (in_target - layout).ravel() / sigma, [J / sigma for J in jacobians]

    return CheckedFactor(evaluate, 3 * len(seen), keys, [6, 6, *[3] * len(seen), *([1] if with_scale else [])])
