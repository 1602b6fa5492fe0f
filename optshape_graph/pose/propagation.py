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
ring that both its ends share. Several candidate poses are
worked on at once.

Evidence that the posterior leaves out is free: where the rings that returned nothing would have met the target
(`missed_rings`), and that each ring leaves it within an edge, not on its extension (`exit_probability`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.chords import chords, sight_planes
from optshape_graph.edges import EdgePoints
from optshape_graph.gaussian import log_ndtr, mixture_moments
from optshape_graph.pose.ends import EdgeGeometry, Problem
from optshape_graph.se3 import exp, vec, vec_derivative
from optshape_graph.sensor import SensorModel

_WEAK_PRIOR = np.diag([0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-4])
"""Information of the pose before any measurement (3 rad, 100 m): keeps an unobservable pose finite."""

_LARGEST_STEP = 0.15
"""Rotation by which a relinearisation moves a pose at most, rad."""

DAMPING = 0.8
"""Share of each update of an edge point that is taken."""


@dataclass(frozen=True, eq=False, repr=False)
class Posterior(Value):
    """Gaussian posteriors about C poses.

    Attributes:
        T_target_lidar: (C, 4, 4).
        covariance: (C, 6, 6) of the right perturbation of T_target_lidar, rotation first.
        joint: (C, 7, 7) of that and the offset, in beam widths.
        offset: (C,) common offset across the edges, in units of the beam's width; positive: the returns lie further in.
        geometry: edge points at these poses.
        inset: (C, M) distance along the ring from each edge point to the boundary, rad, offset and shift apart.
        shift: (C, M) outward motion of each edge point with its ring, where azimuths are noisy, and by blooming, rad.
        sigma: (C, M) standard deviation across the edge, metres, that stands for each interval.
        log_likelihood: (C,) logarithm of the probability of the edge points, and of what else of the scan was taken
            into account, up to a constant of the scan.
    """

    T_target_lidar: Floats
    covariance: Floats
    joint: Floats
    offset: Floats
    geometry: EdgeGeometry
    inset: Floats
    shift: Floats
    sigma: Floats
    log_likelihood: Floats

    def select(self, index: Ints | slice) -> Posterior:
        """Return some of the posteriors: a slice of them, or those at indices (K,)."""
        return _made(lambda values: values[0][index], self)


def concatenate(a: Posterior, b: Posterior) -> Posterior:
    """Return the posteriors of both."""
    return _made(np.concatenate, a, b)


def _made(make: Callable[[list[Floats]], Floats], *posteriors: Posterior) -> Posterior:
    """Make each array of a posterior, those of its geometry included, of the same arrays of some others."""

    def arrays(records: Sequence[Posterior | EdgeGeometry]) -> dict[str, Any]:
        names = [name for name in vars(records[0]) if name != "geometry"]
        return {name: make([getattr(record, name) for record in records]) for name in names}

    geometry = EdgeGeometry(**arrays([posterior.geometry for posterior in posteriors]))
    return Posterior(geometry=geometry, **arrays(posteriors))


def propagate(
    problem: Problem, T: Floats, *, relinearisations: int, sweeps: int, labels: Ints | None = None
) -> Posterior:
    """Find the posterior about each of C poses.

    Args:
        problem: one target in one scan.
        T: (C, 4, 4) T_target_lidar to start from.
        labels: (C, M) association; None: each ring ends on the edge it leaves by first, as the poses move.
        relinearisations: how often the poses move to their posterior means.
        sweeps: updates of all edge points between two relinearisations.
    """
    middle, width = problem.edges.middle, problem.edges.width
    offset = np.zeros(len(T))
    inset = np.broadcast_to(middle, (len(T), len(width)))
    spread = np.broadcast_to(width**2 / 12, inset.shape)
    previous = labels
    for iteration in range(relinearisations):
        settled = iteration == relinearisations - 1  # the last association is the one the posterior is of
        geometry = problem.geometry(T, labels if labels is not None or not settled else previous)
        if previous is not None:
            changed = geometry.labels != previous
            inset, spread = np.where(changed, middle, inset), np.where(changed, width**2 / 12, spread)
        previous = geometry.labels
        step, posterior = _sweep(problem, T, geometry, offset, inset, spread, sweeps)
        inset, offset = posterior.inset, posterior.offset
        along = np.maximum(np.abs(geometry.along), 1e-3 * np.linalg.norm(problem.edges.points, axis=1))
        spread = np.maximum(posterior.sigma**2 - geometry.own, 1e-8 * along**2 * width**2) / along**2
        largest = np.abs(step[:, :3]).max(axis=1, initial=0.0)
        T = T @ exp(step * np.minimum(1.0, _LARGEST_STEP / np.maximum(largest, 1e-12))[:, None])
    return replace(posterior, T_target_lidar=T)


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
    problem: Problem,
    geometry: EdgeGeometry,
    precision0: Floats,
    shift0: Floats,
    J: Floats,
    r: Floats,
    inset: Floats,
    spread: Floats,
    sweeps: int,
    settled: float = 1e-3,
) -> Step:
    """Update the Gaussians of all edge points `sweeps` times, linearised where the step is 0.

    Args:
        problem: one target in one scan.
        geometry: its edge points, from C poses.
        precision0: (C, K, K) information matrix of the step before the edge points, and
        shift0: (C, K) its information vector.
        J: (C, M, K) derivative of the residuals r by the unknowns.
        r: (C, M) residuals at step 0, metres, insets left out.
        inset: (C, M) distance to the boundary to start from, rad, and
        spread: (C, M) its variance, square rad.
        sweeps: at most so many updates.
        settled: relative change of every precision below which more updates change nothing.
    """
    own, s = geometry.own, geometry.along
    intervals = residual_intervals(s, problem)
    tau = 1.0 / (own + spread * s**2)
    nu = -tau * inset * s
    Jt = np.swapaxes(J, 1, 2)
    change = np.inf
    for sweep in range(sweeps + 1):
        precision = precision0 + Jt @ (tau[..., None] * J)
        shift = shift0 + (Jt @ (nu - tau * r)[..., None])[..., 0]
        covariance = np.linalg.inv(precision)
        mean = (covariance @ shift[..., None])[..., 0]
        variance = ((J @ covariance) * J).sum(axis=-1)
        prediction = r + (J @ mean[..., None])[..., 0]
        site = update_sites(prediction, variance, own, intervals, tau, nu)
        if sweep == sweeps or change < settled:
            break
        change = float(np.max(np.abs(site.precision - tau) / (site.precision + tau)))
        tau, nu = tau + DAMPING * (site.precision - tau), nu + DAMPING * (site.information - nu)
    log_evidence = (
        0.5 * ((mean * shift).sum(axis=-1) - np.linalg.slogdet(precision)[1])
        - 0.5 * (shift0 * np.linalg.solve(precision0, shift0[..., None])[..., 0]).sum(axis=-1)
        + 0.5 * np.linalg.slogdet(precision0)[1]
        + (site.log_mass + 0.5 * _log_ratio(site.cavity_mean, site.cavity_variance, tau, nu)).sum(axis=-1)
        - 0.5 * (tau * r**2 - 2 * nu * r).sum(axis=-1)
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


def _sweep(
    problem: Problem, T: Floats, geometry: EdgeGeometry, offset: Floats, inset: Floats, spread: Floats, sweeps: int
) -> tuple[Floats, Posterior]:
    """Update all edge points at fixed linearisation; the step of the poses' means, and the posteriors."""
    points, m = problem.edges.points, geometry.direction @ T[:, :3, :3]
    s, by_shift = geometry.along, np.hstack([problem.blooming, problem.ring_shifts])
    columns = [np.cross(points, m), m, geometry.across[..., None], s[..., None] * by_shift]
    J = np.concatenate(columns, axis=-1)
    r = geometry.residual + offset[:, None] * geometry.across

    D, z = vec_derivative(T), vec(T)
    precision0 = np.zeros((len(T), J.shape[-1], J.shape[-1])) + np.eye(J.shape[-1])
    precision0[:, :6, :6] = np.swapaxes(D, 1, 2) @ problem.plane[:12, :12] @ D + _WEAK_PRIOR
    shift0 = np.zeros(precision0.shape[:2])
    shift0[:, :6] = -((z @ problem.plane[:12, :12] + problem.plane[12, :12])[:, None] @ D)[:, 0]
    precision0[:, 6, 6] = 1.0 / problem.beam.common**2
    shift0[:, 6] = -precision0[:, 6, 6] * offset

    step = posterior_step(problem, geometry, precision0, shift0, J, r, inset, spread, sweeps)
    fast = np.where(np.abs(s) > 1e-3 * np.linalg.norm(points, axis=1), s, np.inf)
    posterior = Posterior(
        T_target_lidar=T,
        covariance=np.asarray(step.covariance[:, :6, :6]),
        joint=np.asarray(step.covariance[:, :7, :7]),
        offset=offset + step.mean[:, 6],
        geometry=geometry,
        inset=np.clip(-(step.information / step.precision) / fast, *problem.intervals[1]),
        shift=step.mean[:, 7:] @ by_shift.T,
        sigma=1.0 / np.sqrt(step.precision),
        log_likelihood=step.log_evidence,
    )
    return step.mean[:, :6], posterior


def _log_ratio(cavity_mean: Floats, cavity_variance: Floats, tau: Floats, nu: Floats) -> Floats:
    """Twice the logarithm of what divides a site's normaliser: of exp(nu r - tau r^2 / 2) under the cavity."""
    precision = 1.0 / cavity_variance
    total, shift = precision + tau, cavity_mean * precision + nu
    return np.asarray(np.log(total / precision) - shift**2 / total + cavity_mean**2 * precision)


def residual_intervals(along: Floats, problem: Problem) -> tuple[Floats, Floats, Floats]:
    """Where the residual of a boundary point lies (2, C, M): within its interval, or, for a lost return, about it.

    Densities are per step. A point that leaves its edge inwards cannot have ended there: its first interval is
    empty of weight.
    """
    edges, options = problem.edges, problem.options
    residuals = -problem.intervals[:, :, None] * along
    lower, upper = residuals.min(axis=1) - 1e-7, residuals.max(axis=1) + 1e-7
    span = options.lost_span[1] - options.lost_span[0]
    log_density = np.zeros((2, *along.shape))
    log_density[0] = np.log(1 - options.lost_ends) - np.log(edges.width / np.maximum(edges.width, edges.azimuth_step))
    log_density[0] -= np.where(along > 0, 0.0, 20.0)
    log_density[1] = np.log(options.lost_ends / span)
    return lower, upper, log_density


def missed_rings(problem: Problem, posterior: Posterior, ends: EdgePoints, sensor: SensorModel) -> Floats:
    """Logarithm of the probability (C,) that the rings without returns return nothing.

    A ring that crosses the target by less than a step may fall between two firings. Beyond that it must have been
    lost: occluded, outside the field of view, dropped. How often that happens, the rings between the lowest and the
    highest that did return tell.

    Args:
        problem: one target in one scan.
        posterior: of C poses.
        ends: of the rings that returned.
        sensor: whose table says which rings there are.
    """
    T = posterior.T_target_lidar
    vertices = (problem.target.vertices - T[:, None, :3, 3]) @ T[:, :3, :3]
    ranges = np.linalg.norm(problem.edges.points, axis=1)
    narrower = (
        2 * posterior.offset * float(np.mean(problem.beam.width(ranges) / ranges))
    )  # as the target seems to the rings
    lost = ends.lost_rings
    outer = np.delete(sensor.elevations, slice(ends.ring[0], ends.ring[-1] + 1))
    right, left = chords(sight_planes(vertices), outer, ends.reference_azimuth)
    with np.errstate(invalid="ignore"):
        steps = np.nan_to_num((left - right - narrower[:, None]) / ends.azimuth_step, neginf=0.0)
    unseen = np.clip(1.0 - steps, 0.0, 1.0)
    return np.asarray(np.log(unseen * (1 - lost) + lost).sum(axis=1))


def other_edges(problem: Problem, posterior: Posterior) -> Floats:
    """Distance (C, M, n), metres, of boundary points beyond each edge line; -inf for the edge each is assigned to."""
    geometry, target = posterior.geometry, problem.target
    T = posterior.T_target_lidar
    boundary = _boundary(problem, posterior)
    y = (boundary @ np.swapaxes(T[:, :3, :3], 1, 2)) + T[:, None, :3, 3]
    beyond = y[..., 1:] @ target.normals.T - target.offsets
    np.put_along_axis(beyond, geometry.labels[..., None], -np.inf, axis=-1)
    return np.asarray(beyond)


def _boundary(problem: Problem, posterior: Posterior) -> Floats:
    """(C, M, 3) where the posterior puts the boundary that each edge point stands for, LiDAR frame, on the plane."""
    T, edges = posterior.T_target_lidar, problem.edges
    normal = T[:, 0, :3]
    ray = edges.points + (posterior.inset + posterior.shift)[..., None] * edges.sweep
    return np.asarray(ray * (-T[:, 0, 3, None] / np.einsum("ci,cmi->cm", normal, ray))[..., None])


def exit_probability(problem: Problem, posterior: Posterior) -> Floats:
    """Logarithm of the probability (C,) that each ring leaves the target by the edge it is assigned to.

    Edge lines are infinite; the target is not: a boundary point must be inside all other edges, as far as the
    pose and the point's own scatter tell, down to the probability of a lost return.
    """
    beyond = other_edges(problem, posterior)
    worst = beyond.argmax(axis=-1)
    R = posterior.T_target_lidar[:, :3, :3]
    normal = np.concatenate([np.zeros((*worst.shape, 1)), problem.target.normals[worst]], axis=-1) @ R
    J = np.concatenate([np.cross(_boundary(problem, posterior), normal), normal], axis=-1)
    variance = ((J @ posterior.covariance) * J).sum(axis=-1)
    variance += posterior.geometry.own
    inside = log_ndtr(-np.take_along_axis(beyond, worst[..., None], axis=-1)[..., 0] / np.sqrt(variance))
    return np.asarray(np.maximum(inside, np.log(0.1 * problem.options.lost_ends)).sum(axis=1))


def alternative_labels(problem: Problem, posterior: Posterior, limit: int) -> Ints:
    """Labels (V, M) of the associations that differ from a posterior's in one edge point near a vertex.

    Args:
        problem: one target in one scan.
        posterior: of one pose.
        limit: at most so many, those nearest to a vertex.
    """
    beyond = other_edges(problem, posterior)[0]
    nearest = beyond.argmax(axis=-1)
    reach = 0.5 * np.abs(posterior.geometry.along[0]) * problem.edges.width
    closeness = -beyond.max(axis=-1) / (posterior.sigma[0] + reach)
    order = np.argsort(closeness)[:limit]
    order = order[closeness[order] < 1.0]
    labels = np.repeat(posterior.geometry.labels, len(order), axis=0)
    labels[np.arange(len(order)), order] = nearest[order]
    return labels
