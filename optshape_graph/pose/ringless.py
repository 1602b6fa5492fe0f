"""Our method for clouds without rings (Livox, flash LiDARs, merged clouds): all poses that contain the returns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.edges import EdgePoints
from optshape_graph.errors import EstimationError
from optshape_graph.factors.measurement import template_rows
from optshape_graph.factors.se3 import inverse, inverse_covariance
from optshape_graph.factors.static import BiasedMeasurement
from optshape_graph.pose.association import ReturnsPlane, fit_plane, in_plane_poses
from optshape_graph.pose.containment import REACH, Beam, Containment, containing_poses
from optshape_graph.pose.enumerated import refine
from optshape_graph.pose.estimate import (
    AMBIGUITY_MARGIN,
    Ambiguity,
    PoseEstimate,
    Status,
    unobservable_directions,
)
from optshape_graph.pose.noise import EdgeNoise, PlaneReturns, plane_measurement, returns_on_plane
from optshape_graph.pose.sdp import Backend, certify
from optshape_graph.scan import Scan
from optshape_graph.target import Target

MAX_OUTSIDE = 0.02
"""Share of returns that may lie outside the outline by more than the beam allows: more, and these are not this
target's returns."""

BANDS = (4, 16, 64, 256)
"""Into how many bands of elevation the returns are cut, at each of several scales, each band with a range bias."""


def estimate_ringless(scan: Scan, target: Target, backend: Backend = "clarabel") -> PoseEstimate:
    """Estimate a target's pose from returns without rings; see `estimate_pose`.

    Raises:
        EstimationError: no pose contains the returns.
    """
    plane = fit_plane(scan.points, None)
    returns = _with_biases(scan, plane)
    q = ((returns.points - plane.centre) @ plane.axes.T)[:, 1:]
    edge = EdgeNoise.of(scan.sensor)
    width = float(np.median(edge.width(np.linalg.norm(scan.points, axis=1))))
    beam = Beam(float(np.hypot(edge.floor, edge.OWN * width)), edge.COMMON * width)
    sets = containing_poses(q, beam, target)
    if not sets:
        raise EstimationError(f"{scan.name}: at no pose does '{target.name}' contain the returns: not this target")
    best = sets[0]

    outline = _outline_measurement(best, plane)
    names = [f"range bias {k}" for k in returns.rings]
    shared = outline + plane_measurement(returns, names)
    start = in_plane_poses(best.mean[:1], best.mean[None, 1:], plane)[0]
    measurement = shared.marginal(1.0).at(start)
    T_target_lidar = refine(measurement)
    measurement = measurement.at(T_target_lidar)
    weight = float((1 / returns.sigma**2).sum()) + float(np.trace(np.linalg.inv(best.covariance[1:, 1:])))
    certificate = certify(measurement, T_target_lidar, weight, backend)

    T_lidar_target = inverse(T_target_lidar)
    information = measurement.information(T_target_lidar) + 1e-9 * np.eye(6)
    covariance = inverse_covariance(T_target_lidar, np.linalg.inv(information))
    ambiguity = _ambiguity(sets, plane)
    unobservable = unobservable_directions(covariance, target.circumradius)
    at_target = scan.points @ T_target_lidar[:3, :3].T + T_target_lidar[:3, 3]
    outside = target.outside_distance((q @ _turn(best.mean[0]).T) + best.mean[1:])
    status, reason = _verdict(float(np.mean(outside > REACH * (beam.sigma + beam.offset))), unobservable, ambiguity)
    return PoseEstimate(
        target=target,
        T_lidar_target=T_lidar_target,
        covariance=covariance,
        status=status,
        reason=reason,
        measurement=measurement,
        shared=shared,
        certificate=certificate,
        global_association=True,
        ambiguity=ambiguity,
        log_likelihood=float(np.logaddexp.reduce([one.log_mass for one in sets]) - len(scan) * np.log(target.area)),
        edge_points=EdgePoints.none(),
        labels=np.zeros(0, dtype=np.int64),
        inset=np.zeros(0),
        edge_sigma=np.zeros(0),
        edge_residuals=np.zeros(0),
        plane_rms=float(np.sqrt(np.mean(at_target[:, 0] ** 2))),
        n_returns=len(scan),
        unobservable=unobservable,
    )


def _with_biases(scan: Scan, plane: ReturnsPlane) -> PlaneReturns:
    """The returns against the plane, with range biases at several scales.

    Lasers, each with a range bias, are not told apart in the cloud, and a bias may drift with the direction: beside
    one for all, bands of elevation, broad and narrow, stand for them. One scale alone would take the slopes within its
    bands, or those between them, for certain.
    """
    elevation = np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1]))
    fraction = (elevation - elevation.min()) / max(float(np.ptp(elevation)), 1e-9)
    returns = returns_on_plane(scan.points, None, plane.axes[0], plane.distance, scan.sensor, 0.0)
    columns = [returns.bias]
    for count in BANDS:
        band = np.minimum((fraction * count).astype(int), count - 1)
        columns.append(returns.bias * (band[:, None] == np.unique(band)) / np.sqrt(len(BANDS)))
    bias = np.hstack(columns)
    return replace(returns, bias=bias, rings=np.arange(bias.shape[1]))


def _outline_measurement(best: Containment, plane: ReturnsPlane) -> BiasedMeasurement:
    """The posterior in the plane as whitened residuals that are linear in T_target_lidar.

    With the posterior's target axes d, e in the plane, its axes a, b and its centre o, they are the turn
    (e . R a - d . R b) / 2, which grows as its sine, and the target's (y, z) of o. The turn vanishes for mirrored and
    opposite axes too; d . R a - 1 and e . R b - 1 tell those apart, and are of second order near the posterior.
    """
    o, a, b = plane.centre, plane.axes[1], plane.axes[2]
    d, e = np.column_stack([np.zeros(2), _turn(best.mean[0]).T])
    y, z = np.eye(3)[1:]

    def axis(m: Floats, v: Floats) -> Floats:
        """Row of m . R v: of m . (R p + t) at o + v, less that at o."""
        ahead, here = template_rows(np.array([o + v, o]), np.array([m, m]), np.zeros(2))[0]
        return np.asarray(ahead - here)

    information = np.linalg.inv(best.covariance)
    whiten = np.linalg.cholesky(information).T
    centre = template_rows(np.array([o, o]), np.array([y, z]), np.zeros(2))[0]
    turn = 0.5 * (axis(e, a) - axis(d, b))
    way = np.sqrt(0.5 * information[0, 0]) * np.array([axis(d, a), axis(e, b)])
    rows = np.vstack([whiten @ np.vstack([turn, centre]), way])
    constants = np.concatenate([-whiten @ [0.0, *best.mean[1:]], -np.sqrt(0.5 * information[0, 0]) * np.ones(2)])
    return BiasedMeasurement.from_rows(rows, np.zeros((5, 0)), constants, np.eye(4), shared=[])


def _ambiguity(sets: list[Containment], plane: ReturnsPlane) -> Ambiguity:
    """Margin between the likeliest set of poses and the next."""
    if len(sets) == 1:
        return Ambiguity(np.inf, None)
    rival = in_plane_poses(sets[1].mean[:1], sets[1].mean[None, 1:], plane)[0]
    return Ambiguity(sets[0].log_mass - sets[1].log_mass, inverse(rival))


def _verdict(outside: float, unobservable: tuple[str, ...], ambiguity: Ambiguity) -> tuple[Status, str]:
    if outside > MAX_OUTSIDE:
        return "failed", f"{outside:.0%} of the returns lie outside the outline: not this target, or returns are mixed"
    if unobservable:
        return "failed", "not observable: " + "; ".join(unobservable)
    if ambiguity.margin < AMBIGUITY_MARGIN:
        return "ambiguous", f"a different pose is only {ambiguity.margin:.2g} less likely (log likelihood)"
    return "ok", ""


def _turn(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])
