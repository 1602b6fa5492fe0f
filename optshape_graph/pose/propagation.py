"""The posterior of a target's pose, by expectation propagation over its edge points.

Each edge point says that the boundary lies in an interval along its ring (`intervals`), which is no Gaussian. What
it says *together with all others* is close to one: expectation propagation (Minka, 2001) finds for each edge point the
Gaussian that stands for its interval in the company of the rest. The result is both an estimate, the posterior mean,
and a weighted least-squares problem with that solution: each edge point has an inset, the distance to the boundary, and
a standard deviation.

Unknowns: a right perturbation of T_target_lidar (6), the offset across the edges that all edge points of a scan share
(1), and where azimuths are noisy, the shift along each ring that both its ends share. Several candidate poses are
worked on at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.edges import EdgePoints
from optshape_graph.factors.se3 import vec, vec_derivative
from optshape_graph.pose.intervals import mixture_moments
from optshape_graph.pose.noise import LOST_RETURNS, LOST_SPAN, EdgeNoise, outermost_return
from optshape_graph.target import Target

_WEAK_PRIOR = np.diag([0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-4])
"""Information of the pose before any measurement (3 rad, 100 m): keeps an unobservable pose finite."""

_LARGEST_STEP = 0.15
"""Rotation by which a relinearisation moves a pose at most, rad."""


_SETTLED = 1e-3
"""Relative change of every edge point's precision below which more sweeps change nothing."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What is known of one target in one scan, whatever its pose.

    Attributes:
        edges: both ends of each ring.
        target: the template.
        plane: (13, 13) quadratic form in [z; 1] of the returns' whitened distances from the plane.
        noise: scatter of the ring ends about the edges.
    """

    edges: EdgePoints
    target: Target
    plane: Floats
    noise: EdgeNoise


@dataclass(frozen=True, eq=False)
class EdgeGeometry:
    """Edge points against their edges at C poses: rows linear in the pose, and which way the unknowns move them.

    Attributes:
        labels: (C, M) edge of each edge point.
        direction: (C, M, 3) vector m of each row, target frame: m . (R p + t) - c is the distance from the edge, in
            the plane, of the point where the ray of p meets the plane.
        residual: (C, M) that distance, metres, negative inside, `shift` taken off.
        along: (C, M) how fast it grows along the ring, outwards, metres per radian.
        across: (C, M) how fast it grows with the offset across the edge, metres per beam width.
        shift: (C, M) how much further out the last return lies than a single ray would, metres.
        scatter: (C, M) its own scatter across the edge, relative to that of a single ray.
    """

    labels: Ints
    direction: Floats
    residual: Floats
    along: Floats
    across: Floats
    shift: Floats
    scatter: Floats


@dataclass(frozen=True, eq=False)
class Posterior:
    """Gaussian posteriors about C poses.

    Attributes:
        T_target_lidar: (C, 4, 4).
        covariance: (C, 6, 6) of the right perturbation of T_target_lidar, rotation first.
        joint: (C, 7, 7) of that and the offset.
        offset: (C,) common offset across the edges, in units of the beam's width; positive: the returns lie further in.
        geometry: edge points at these poses.
        inset: (C, M) distance along the ring from each edge point to the boundary, rad, offset and shift apart.
        shift: (C, M) outward motion of each edge point with its ring, where azimuths are noisy, rad.
        sigma: (C, M) standard deviation across the edge, metres, that stands for each interval.
        log_evidence: (C,) logarithm of the probability of the edge points, up to a constant of the scan.
    """

    T_target_lidar: Floats
    covariance: Floats
    joint: Floats
    offset: Floats
    geometry: EdgeGeometry
    inset: Floats
    shift: Floats
    sigma: Floats
    log_evidence: Floats

    def select(self, index: Ints | slice) -> Posterior:
        """Return some of the posteriors: a slice of them, or those at indices (K,)."""
        geometry = EdgeGeometry(**{name: value[index] for name, value in vars(self.geometry).items()})
        rest = {name: value[index] for name, value in vars(self).items() if name != "geometry"}
        return Posterior(geometry=geometry, **rest)


def concatenate(a: Posterior, b: Posterior) -> Posterior:
    """Return the posteriors of both."""

    def both(name: str, one: object, other: object) -> Floats:
        return np.concatenate([getattr(one, name), getattr(other, name)])

    geometry = EdgeGeometry(**{name: both(name, a.geometry, b.geometry) for name in vars(a.geometry)})  # type: ignore[arg-type]  # all are arrays
    rest = {name: both(name, a, b) for name in vars(a) if name != "geometry"}
    return Posterior(geometry=geometry, **rest)


def edge_geometry(problem: Problem, T: Floats, labels: Ints | None = None) -> EdgeGeometry:
    """Look at the edge points from C poses (C, 4, 4); without labels, a ring ends on the edge it leaves by first."""
    edges, target = problem.edges, problem.target
    R, t = T[:, :3, :3], T[:, :3, 3]
    normal = R[:, 0]
    p = edges.points
    turning = edges.sweep
    distance = normal @ p.T
    outward = turning - p * ((normal @ turning.T) / distance)[..., None]
    u = (outward @ np.swapaxes(R, 1, 2))[..., 1:]
    y = p @ np.swapaxes(R, 1, 2) + t[:, None]
    ray = (p / np.linalg.norm(p, axis=1, keepdims=True)) @ np.swapaxes(R, 1, 2)
    slope = ray[..., 1:] / ray[..., :1]
    if labels is None:
        labels = _exit_edges(y[..., 1:] - slope * y[..., :1], u, target)
    n = target.normals[labels]
    mu = (n * slope).sum(axis=-1)
    direction = np.concatenate([-mu[..., None], n], axis=-1)
    along = (n * u).sum(axis=-1)
    across = problem.noise.width(np.linalg.norm(p, axis=1)) * np.sqrt(1.0 + mu**2)
    shift, scatter = outermost_return(np.abs(along) * edges.width / across)
    shift = shift * across
    return EdgeGeometry(
        labels=labels,
        direction=direction,
        residual=(direction * y).sum(axis=-1) - target.offsets[labels] - shift,
        along=along,
        across=across,
        shift=shift,
        scatter=scatter,
    )


def _exit_edges(yz: Floats, outward: Floats, target: Target) -> Ints:
    """Edge by which rays in the plane (C, M, 2) first leave the polygon; the nearest line where none is ahead."""
    beyond = yz @ target.normals.T - target.offsets
    speed = outward @ target.normals.T
    scale = 1e-3 * np.linalg.norm(outward, axis=-1, keepdims=True)
    ahead = np.where(speed > scale, -beyond / np.maximum(speed, scale), np.inf)
    leaves = np.isfinite(ahead.min(axis=-1))
    return np.asarray(np.where(leaves, ahead.argmin(axis=-1), np.abs(beyond).argmin(axis=-1)))


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
        geometry = edge_geometry(problem, T, labels if labels is not None or not settled else previous)
        if previous is not None:
            changed = geometry.labels != previous
            inset, spread = np.where(changed, middle, inset), np.where(changed, width**2 / 12, spread)
        previous = geometry.labels
        step, posterior = _sweep(problem, T, geometry, offset, inset, spread, sweeps)
        inset, offset = posterior.inset, posterior.offset
        along = np.maximum(np.abs(geometry.along), 1e-3 * np.linalg.norm(problem.edges.points, axis=1))
        spread = np.maximum(posterior.sigma**2 - own_variance(problem, geometry), 1e-8 * along**2 * width**2) / along**2
        largest = np.abs(step[:, :3]).max(axis=1, initial=0.0)
        T = T @ _exp(step * np.minimum(1.0, _LARGEST_STEP / np.maximum(largest, 1e-12))[:, None])
    return replace(posterior, T_target_lidar=T)


def own_variance(problem: Problem, geometry: EdgeGeometry) -> Floats:
    """(C, M) variance across the edge that is each edge point's own, quantisation apart, m2."""
    along = problem.edges.scatter * geometry.along
    return np.asarray(problem.noise.floor**2 + (problem.noise.OWN * geometry.scatter * geometry.across) ** 2 + along**2)


def ring_shifts(edges: EdgePoints) -> Floats:
    """(M, K) outward motion, rad, of each edge point for a standard deviation of each noisy ring's shift."""
    noisy = np.unique(edges.ring[edges.shift > 0])
    return np.asarray((edges.ring[:, None] == noisy) * (edges.side * edges.shift)[:, None])


def _sweep(
    problem: Problem, T: Floats, geometry: EdgeGeometry, offset: Floats, inset: Floats, spread: Floats, sweeps: int
) -> tuple[Floats, Posterior]:
    """Update all edge points `sweeps` times at fixed linearisation; the step of the mean, and the posterior."""
    points, R = problem.edges.points, T[:, :3, :3]
    m = geometry.direction @ R
    s, by_shift = geometry.along, ring_shifts(problem.edges)
    columns = [np.cross(points, m), m, geometry.across[..., None], s[..., None] * by_shift]
    J = np.concatenate(columns, axis=-1)
    Jt = np.swapaxes(J, 1, 2)
    r = geometry.residual + offset[:, None] * geometry.across

    D, z = vec_derivative(T), vec(T)
    precision0 = np.zeros((len(T), J.shape[-1], J.shape[-1])) + np.eye(J.shape[-1])
    precision0[:, :6, :6] = np.swapaxes(D, 1, 2) @ problem.plane[:12, :12] @ D + _WEAK_PRIOR
    shift0 = np.zeros(precision0.shape[:2])
    shift0[:, :6] = -((z @ problem.plane[:12, :12] + problem.plane[12, :12])[:, None] @ D)[:, 0]
    offset_precision = 1.0 / problem.noise.COMMON**2
    precision0[:, 6, 6] = offset_precision
    shift0[:, 6] = -offset_precision * offset

    own = own_variance(problem, geometry)
    lower, upper, log_density = _intervals(s, problem.edges)
    tau = 1.0 / (own + spread * s**2)
    nu = -tau * inset * s
    change = np.inf
    for sweep in range(sweeps + 1):
        precision = precision0 + Jt @ (tau[..., None] * J)
        shift = shift0 + (Jt @ (nu - tau * r)[..., None])[..., 0]
        covariance = np.linalg.inv(precision)
        mean = (covariance @ shift[..., None])[..., 0]
        variance = ((J @ covariance) * J).sum(axis=-1)
        prediction = r + (J @ mean[..., None])[..., 0]
        cavity_variance = 1.0 / np.maximum(1.0 / variance - tau, 1e-4 / variance)
        cavity_mean = cavity_variance * (prediction / variance - nu)
        seen = cavity_variance + own
        log_mass, boundary, boundary_variance = mixture_moments(cavity_mean, seen, lower, upper, log_density)
        if sweep == sweeps or change < _SETTLED:
            break
        gain = cavity_variance / seen
        tilted = cavity_mean + gain * (boundary - cavity_mean)
        tilted_variance = cavity_variance * (1.0 - gain) + gain**2 * boundary_variance
        # Where the mixture's two parts pull apart, a site can turn out to widen: then it says nothing.
        informative = 1.0 / tilted_variance - 1.0 / cavity_variance
        silent = informative < 1e-6 / seen
        new_tau = np.where(silent, 1e-6 / seen, informative)
        new_nu = np.where(silent, 0.0, tilted / tilted_variance - cavity_mean / cavity_variance)
        change = float(np.max(np.abs(new_tau - tau) / (new_tau + tau)))
        tau, nu = tau + 0.8 * (new_tau - tau), nu + 0.8 * (new_nu - nu)

    log_evidence = (
        0.5 * ((mean * shift).sum(axis=-1) - np.linalg.slogdet(precision)[1])
        - 0.5 * (shift0 * np.linalg.solve(precision0, shift0[..., None])[..., 0]).sum(axis=-1)
        + 0.5 * np.linalg.slogdet(precision0)[1]
        + (log_mass + 0.5 * _log_ratio(cavity_mean, cavity_variance, tau, nu)).sum(axis=-1)
        - 0.5 * (tau * r**2 - 2 * nu * r).sum(axis=-1)
    )
    fast = np.where(np.abs(s) > 1e-3 * np.linalg.norm(points, axis=1), s, np.inf)
    posterior = Posterior(
        T_target_lidar=T,
        covariance=np.asarray(covariance[:, :6, :6]),
        joint=np.asarray(covariance[:, :7, :7]),
        offset=offset + mean[:, 6],
        geometry=geometry,
        inset=np.clip(-(nu / tau) / fast, *_lost_interval(problem.edges)),
        shift=mean[:, 7:] @ by_shift.T,
        sigma=1.0 / np.sqrt(tau),
        log_evidence=log_evidence,
    )
    return mean[:, :6], posterior


def _log_ratio(cavity_mean: Floats, cavity_variance: Floats, tau: Floats, nu: Floats) -> Floats:
    """Twice the logarithm of what divides a site's normaliser: of exp(nu r - tau r^2 / 2) under the cavity."""
    precision = 1.0 / cavity_variance
    total, shift = precision + tau, cavity_mean * precision + nu
    return np.asarray(np.log(total / precision) - shift**2 / total + cavity_mean**2 * precision)


def _lost_interval(edges: EdgePoints) -> tuple[Floats, Floats]:
    """Ends (M,), (M,) of where the boundary lies beyond a ring end that is not its last return, rad."""
    step = np.maximum(edges.width, edges.azimuth_step)
    return edges.lower + LOST_SPAN[0] * step, edges.lower + LOST_SPAN[1] * step


def _intervals(along: Floats, edges: EdgePoints) -> tuple[Floats, Floats, Floats]:
    """Where the residual of a boundary point lies (2, C, M): within its interval, or, for a lost return, about it.

    Densities are per step. A point that leaves its edge inwards cannot have ended there: its first interval is
    empty of weight.
    """
    ends = np.array([[edges.lower, edges.upper], _lost_interval(edges)])[:, :, None]
    residuals = -ends * along
    lower, upper = residuals.min(axis=1) - 1e-7, residuals.max(axis=1) + 1e-7
    shape = (2, *along.shape)
    log_density = np.log([[1 - LOST_RETURNS], [LOST_RETURNS / (LOST_SPAN[1] - LOST_SPAN[0])]])
    log_density = np.broadcast_to(log_density[..., None], shape).copy()
    log_density[0] -= np.log(edges.width / np.maximum(edges.width, edges.azimuth_step))
    log_density[0] -= np.where(along > 0, 0.0, 20.0)
    return lower, upper, log_density


def _exp(xi: Floats) -> Floats:
    """Exponential maps (C, 4, 4) of tangent vectors (C, 6), rotation first."""
    return np.array([gtsam.Pose3.Expmap(x).matrix() for x in xi])
