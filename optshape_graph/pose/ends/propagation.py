"""The posterior of a target's pose, by expectation propagation over its edge points.

A ring's last return lies inside the true edge by an azimuth that is uniform over one step: the phase of the firing. A
few lie elsewhere (returns lost at the edge, mixed pixels). So each edge point says that the boundary lies in an
interval along its ring, a mixture of two uniforms, which is no Gaussian. What it says *together with all others* is
close to one: expectation propagation (Minka, 2001) finds for each edge point the Gaussian that stands for its interval
in the company of the rest, by the moments of truncated Gaussians. The result is both an estimate, the posterior mean,
and a weighted least-squares problem with that solution: each edge point has an inset, the distance to the boundary, and
a standard deviation.

Unknowns: a right perturbation of T_target_lidar (6), the offset across the edges that all edge points of a scan share
(1), how much further along the rings a bright target reaches (1), and where azimuths are noisy, the shift along each
ring that both its ends share. Several candidate poses are worked on at once, of one scan or of several.

Evidence that the posterior leaves out is free: where the rings that returned nothing would have met the target
(`missed_rings`), and that each ring leaves it within an edge, not on its extension (`exit_probability`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.chords import chords, sight_planes
from optshape_graph.gaussian import log_ndtr, mixture_moments
from optshape_graph.pose.ends.posterior import Posterior
from optshape_graph.pose.ends.ring_ends import EdgeGeometry, RingEnds
from optshape_graph.se3 import cross, exp, vec, vec_derivative

WEAK_PRIOR = np.diag([0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-4])
"""Information of the pose before any measurement (3 rad, 100 m): keeps an unobservable pose finite."""

INWARDS, GRAZING = 20.0, 0.2
"""Logarithm by which it is less likely that a ring ends at an edge that it crosses inwards, if it does so by a fifth of
a beam from ray to ray or more; where it runs along the edge, by as much less."""

LARGEST_STEP = 0.15
"""Rotation by which a pose moves at most, rad."""

DAMPING = 0.8
"""Share of each update of an edge point that is taken."""


def propagate(ends: RingEnds, T: Floats, geometry: EdgeGeometry, sweeps: int) -> Posterior:
    """Find the posterior about each of C poses, and move it to its mean.

    Args:
        ends: of the scan that each is of, or of the one that all are of.
        T: (C, 4, 4) T_target_lidar to start from.
        geometry: of the ring ends there.
        sweeps: updates of all edge points.
    """
    points, m, s = ends.points, geometry.direction @ T[:, :3, :3], geometry.along
    columns = [cross(points, m), m, geometry.across[..., None], s[..., None] * ends.by_shift]
    J = np.concatenate(columns, axis=-1)
    D, z = vec_derivative(T), vec(T)
    precision0 = np.zeros((len(T), J.shape[-1], J.shape[-1])) + np.eye(J.shape[-1])
    precision0[:, :6, :6] = np.swapaxes(D, 1, 2) @ ends.plane[:, :12, :12] @ D + WEAK_PRIOR
    precision0[:, 6, 6] = 1.0 / ends.offset_sd**2
    shift0 = np.zeros(precision0.shape[:2])
    gradient = (z[:, None] @ ends.plane[:, :12, :12])[:, 0] + ends.plane[:, 12, :12]
    shift0[:, :6] = -(gradient[:, None] @ D)[:, 0]

    step = posterior_step(
        ends, geometry, precision0, shift0, J, geometry.residual, ends.middle, ends.width**2 / 12, sweeps
    )
    fast = np.where(np.abs(s) > ends.slowest, s, np.inf)
    precision = np.where(ends.there, step.precision, 1.0)
    by_turn = step.mean[:, :6]
    largest = np.abs(by_turn[:, :3]).max(axis=1, initial=0.0)
    return Posterior(
        T_target_lidar=T @ exp(by_turn * np.minimum(1.0, LARGEST_STEP / np.maximum(largest, 1e-12))[:, None]),
        covariance=np.asarray(step.covariance[:, :6, :6]),
        joint=np.asarray(step.covariance[:, :7, :7]),
        offset=step.mean[:, 6],
        geometry=geometry,
        inset=np.clip(-(step.information / precision) / fast, *ends.lost_limits),
        shift=(ends.by_shift @ step.mean[:, 7:, None])[..., 0],
        sigma=1.0 / np.sqrt(precision),
        log_likelihood=step.log_evidence,
    )


@dataclass(frozen=True, eq=False, repr=False)
class Step(Value):
    """The Gaussian posterior of a step of C sets of K unknowns, and the Gaussians that stand for the intervals.

    Attributes:
        mean: (C, K), in units of the unknowns: rad, metres, beam widths.
        covariance: (C, K, K), in those units squared.
        precision: (C, M) of the Gaussian in the residual that stands for each interval, 1/m2.
        information: (C, M) its mean times its precision, 1/m.
        log_evidence: (C,) logarithm of the probability of the edge points.
    """

    mean: Floats
    covariance: Floats
    precision: Floats
    information: Floats
    log_evidence: Floats


def posterior_step(
    ends: RingEnds,
    geometry: EdgeGeometry,
    precision0: Floats,
    shift0: Floats,
    J: Floats,
    r: Floats,
    inset: Floats,
    spread: Floats,
    sweeps: int,
) -> Step:
    """Update the Gaussians of all edge points `sweeps` times, linearised where the step is 0.

    Args:
        ends: of the scan that each pose is of, or of the one that all are of.
        geometry: its edge points, from C poses.
        precision0: (C, K, K) information matrix of the step before the edge points, and
        shift0: (C, K) its information vector.
        J: (C, M, K) derivative of the residuals r by the unknowns.
        r: (C, M) residuals at step 0, metres, insets left out.
        inset: (C, M) distance to the boundary to start from, rad, and
        spread: (C, M) its variance, square rad.
        sweeps: number of updates.
    """
    own, s = geometry.own, geometry.along
    intervals = residual_intervals(geometry, ends)
    tau = ends.there / (own + spread * s**2)
    nu = -tau * inset * s
    Jt = np.swapaxes(J, 1, 2)
    for sweep in range(sweeps + 1):
        precision = precision0 + Jt @ (tau[..., None] * J)
        shift = shift0 + (Jt @ (nu - tau * r)[..., None])[..., 0]
        covariance = np.linalg.inv(precision)
        mean = (covariance @ shift[..., None])[..., 0]
        variance = np.vecdot(J @ covariance, J)
        prediction = r + (J @ mean[..., None])[..., 0]
        site = update_sites(prediction, variance, own, intervals, tau, nu)
        if sweep == sweeps:
            break
        tau = ends.there * (tau + DAMPING * (site.precision - tau))
        nu = ends.there * (nu + DAMPING * (site.information - nu))
    evidence = site.log_mass + 0.5 * _log_ratio(site.cavity_mean, site.cavity_variance, tau, nu)
    log_evidence = (
        0.5 * (np.vecdot(mean, shift) - np.linalg.slogdet(precision)[1])
        - 0.5 * np.vecdot(shift0, np.linalg.solve(precision0, shift0[..., None])[..., 0])
        + 0.5 * np.linalg.slogdet(precision0)[1]
        + (ends.there * evidence - 0.5 * (tau * r**2 - 2 * nu * r)).sum(axis=-1)
    )
    return Step(mean, np.asarray(covariance), tau, nu, log_evidence)


@dataclass(frozen=True, eq=False, repr=False)
class Sites(Value):
    """Gaussians that stand for intervals in the company of everything else, and that company.

    Attributes:
        precision: (...) of each Gaussian in its residual, 1/m2.
        information: (...) its mean times its precision, 1/m.
        cavity_mean: (...) of the residual without it, metres.
        cavity_variance: (...) of that, m2.
        log_mass: (...) logarithm of the interval's probability without it.
    """

    precision: Floats
    information: Floats
    cavity_mean: Floats
    cavity_variance: Floats
    log_mass: Floats


def update_sites(
    prediction: Floats,
    variance: Floats,
    own: Floats,
    intervals: tuple[Floats, Floats, Floats],
    tau: Floats,
    nu: Floats,
) -> Sites:
    """Return the Gaussians that stand for intervals, given what all Gaussians together say of the residuals.

    Args:
        prediction: (...) mean of each residual, metres.
        variance: (...) of that, m2.
        own: (...) variance of each boundary point about its residual, m2.
        intervals: of the residuals, see `residual_intervals`.
        tau: (...) precision of the Gaussians that took part, 1/m2.
        nu: (...) their means times it, 1/m.
    """
    cavity_variance = 1.0 / np.maximum(1.0 / variance - tau, 1e-4 / variance)
    cavity_mean = cavity_variance * (prediction / variance - nu)
    seen = cavity_variance + own
    log_mass, boundary, boundary_variance = mixture_moments(cavity_mean, seen, *intervals)
    gain = cavity_variance / seen
    tilted = cavity_mean + gain * (boundary - cavity_mean)
    tilted_variance = cavity_variance * (1.0 - gain) + gain**2 * boundary_variance
    # Where the mixture's two parts pull apart, a site can turn out to widen: then it says nothing.
    informative = 1.0 / tilted_variance - 1.0 / cavity_variance
    silent = informative < 1e-6 / seen
    return Sites(
        np.where(silent, 1e-6 / seen, informative),
        np.where(silent, 0.0, tilted / tilted_variance - cavity_mean / cavity_variance),
        cavity_mean,
        cavity_variance,
        log_mass,
    )


def _log_ratio(cavity_mean: Floats, cavity_variance: Floats, tau: Floats, nu: Floats) -> Floats:
    """Twice the logarithm of what divides a site's normaliser: of exp(nu r - tau r^2 / 2) under the cavity."""
    precision = 1.0 / cavity_variance
    total, shift = precision + tau, cavity_mean * precision + nu
    return np.asarray(np.log(total / precision) - shift**2 / total + cavity_mean**2 * precision)


def residual_intervals(geometry: EdgeGeometry, ends: RingEnds) -> tuple[Floats, Floats, Floats]:
    """Where the residual of a boundary point lies (2, C, M): within its interval, or, for a lost return, about it.

    Densities are per step. A point that leaves its edge inwards cannot have ended there: its first interval is
    empty of weight. Unless the ring runs along the edge, within the beam: any of its rays may be the last that returns.
    """
    first, last = ends.lost_limits
    limits = -geometry.along * np.stack([[ends.lower, ends.lower + ends.width], [first, last]])
    lower, upper = limits.min(axis=1) - 1e-7, limits.max(axis=1) + 1e-7
    lost, span = ends.lost_ends[:, None], np.diff(ends.lost_span, axis=1)
    inwards = np.clip(-geometry.along * ends.step / (GRAZING * geometry.across), 0.0, 1.0)
    log_density = np.zeros((2, *inwards.shape))
    log_density[0] = np.log(1 - lost) - np.log(ends.width / ends.step) - INWARDS * inwards
    log_density[1] = np.log(lost / span)
    return lower, upper, log_density


def with_what_is_left_out(ends: RingEnds, posterior: Posterior) -> Posterior:
    """Add to posteriors' log likelihoods what else of each scan is taken into account."""
    score = posterior.log_likelihood + exit_probability(ends, posterior) + missed_rings(ends, posterior)
    return replace(posterior, log_likelihood=np.where(np.isfinite(score), score, -np.inf))


def missed_rings(ends: RingEnds, posterior: Posterior) -> Floats:
    """Logarithm of the probability (C,) that the rings without returns return nothing.

    A ring that crosses the target by less than a step may fall between two firings. Beyond that it must have been
    lost: occluded, outside the field of view, dropped. How often that happens, the rings between the lowest and the
    highest that did return tell.

    Args:
        ends: of the scan that each pose is of, or of the one that all are of.
        posterior: of C poses.
    """
    T, lost = posterior.T_target_lidar, ends.lost_rings[:, None]
    vertices = (ends.vertices - T[:, None, :3, 3]) @ T[:, :3, :3]
    narrower = 2 * posterior.offset * ends.beam_angle  # as the target seems to the rings
    right, left = chords(sight_planes(vertices), ends.elevations[:, None], ends.reference_azimuth[:, None])
    with np.errstate(invalid="ignore"):
        steps = np.nan_to_num((left - right - narrower[:, None]) / ends.azimuth_step[:, None], neginf=0.0)
    unseen = np.clip(1.0 - steps, 0.0, 1.0)
    return np.asarray((ends.silent * np.log(unseen * (1 - lost) + lost)).sum(axis=1))


def other_edges(ends: RingEnds, posterior: Posterior) -> tuple[Floats, Floats]:
    """Return how far boundary points lie beyond each edge line (C, M, n), metres, and where they are (C, M, 3).

    Beyond the edge that each is assigned to: -inf. Places are on the plane, LiDAR frame, metres.
    """
    T = posterior.T_target_lidar
    ray = ends.points + (posterior.inset + posterior.shift)[..., None] * ends.sweep
    boundary = ray * (-T[:, 0, 3, None, None] / (ray @ T[:, 0, :3, None]))
    y = boundary @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
    beyond = y[..., 1:] @ np.swapaxes(ends.normals, 1, 2) - ends.offsets[:, None]
    np.put_along_axis(beyond, posterior.geometry.labels[..., None], -np.inf, axis=-1)
    return np.asarray(beyond), boundary


def exit_probability(ends: RingEnds, posterior: Posterior) -> Floats:
    """Logarithm of the probability (C,) that each ring leaves the target by the edge it is assigned to.

    Edge lines are infinite; the target is not: a boundary point must be inside all other edges, as far as the
    pose and the point's own scatter tell, down to the probability of a lost return.
    """
    beyond, boundary = other_edges(ends, posterior)
    worst = beyond.argmax(axis=-1)
    R, scan = posterior.T_target_lidar[:, :3, :3], np.arange(len(ends.normals))[:, None]
    normal = ends.normals[scan, worst] @ R[:, 1:]
    J = np.concatenate([cross(boundary, normal), normal], axis=-1)
    variance = np.vecdot(J @ posterior.covariance, J) + posterior.geometry.own
    inside = log_ndtr(-np.take_along_axis(beyond, worst[..., None], axis=-1)[..., 0] / np.sqrt(variance))
    least = np.log(0.1 * ends.lost_ends)[:, None]
    return np.asarray((ends.there * np.maximum(inside, least)).sum(axis=1))
