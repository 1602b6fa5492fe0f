"""The door of clouds without rings (Livox, flash LiDARs, merged clouds): at which poses does the target contain them?

Where nothing is known of the order in which rays were fired, a return says one thing of the outline: it lies inside, to
within the beam. If the target was sampled evenly, every pose that contains all returns is as likely as any other: the
posterior is uniform over them, and falls off as a beam does where a return comes to lie outside. No edge is
associated with any return, so nothing depends on where a search starts: for each angle the translations that contain
the returns are a polygon, and the angles at which there are any are found by going once around.

Which part of a beam decides whether it returns from the target or from behind it depends on the background, and an
uneven sampling pulls the outline towards where returns are dense: each edge seems further out or in than it is, by
something of its own that no number of returns averages away. The posterior is integrated over those offsets too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from optshape_graph._arrays import Bools, Floats, Value
from optshape_graph.errors import EstimationError
from optshape_graph.factors.measurement import refine, template_rows
from optshape_graph.factors.static import BiasedMeasurement
from optshape_graph.plane import ReturnsPlane
from optshape_graph.pose.evidence import Evidence, Finding
from optshape_graph.se3 import inverse
from optshape_graph.target import Target

REACH = 3.0
"""Standard deviations of the beam by which a return may lie outside where poses are looked for."""

_ANGLES = np.radians(np.arange(0.0, 360.0, 0.5))
_DIRECTIONS = np.radians(np.arange(0.0, 360.0, 1.0))
_GRID = (21, 13, 13)  # angles and translations at which a posterior is evaluated
_CERTAIN = 6.0  # standard deviations inside which a return surely is
_SPAN = 4.0  # standard deviations to either side that the second evaluation covers


def find_by_containment(evidence: Evidence) -> Finding:
    """Find a target's pose by all poses that contain the returns; see `estimate_pose`.

    Raises:
        EstimationError: no pose contains the returns.
    """
    scan, target, plane = evidence.scan, evidence.problem.target, evidence.plane
    q = ((evidence.returns.points - plane.centre) @ plane.axes.T)[:, 1:]

    # Every connected set of poses that contain them, the likeliest first.
    slack = Slack.of(evidence)
    sets = containing_poses(q, slack, target)
    if not sets:
        raise EstimationError(f"{scan.name}: at no pose does '{target.name}' contain the returns: not this target")
    best = sets[0]
    poses = plane.poses(np.array([one.mean[0] for one in sets]), np.array([one.mean[1:] for one in sets]))
    mirrored = containing_poses(q * [-1.0, 1.0], slack, target)

    # The likeliest set and the plane in one measurement, at its minimum.
    shared = _outline_measurement(best, plane) + evidence.on_plane
    exact = shared.marginal(1.0)
    T_target_lidar = refine(exact.at(poses[0]))
    shared = evidence.displaced(shared, T_target_lidar)
    margin, rival = (np.inf, None) if len(sets) == 1 else (best.log_mass - sets[1].log_mass, inverse(poses[1]))
    outside = target.outside_distance(q @ _turn(best.mean[0]).T + best.mean[1:]) > REACH * (slack.sigma + slack.offset)
    return Finding(
        evidence=evidence,
        measurement=shared.marginal(1.0).at(T_target_lidar),
        exact=exact,
        shared=shared,
        total_weight=float((1 / evidence.returns.sigma**2).sum() + np.trace(np.linalg.inv(best.covariance[1:, 1:]))),
        margin=margin,
        rival=rival,
        log_likelihood=float(np.logaddexp.reduce([one.log_mass for one in sets]) - len(scan) * np.log(target.area)),
        labels=np.zeros(0, dtype=np.int64),
        inset=np.zeros(0),
        edge_sigma=np.zeros(0),
        edge_residuals=np.zeros(0),
        ends=None,
        mirrored=mirrored[0].log_mass - best.log_mass if mirrored else 0.0,
        objection=""
        if outside.mean() <= evidence.problem.options.max_outside
        else f"{outside.mean():.0%} of the returns lie outside the outline: not this target, or returns are mixed",
    )


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
    return BiasedMeasurement.from_rows(rows, np.zeros((5, 0)), constants, np.eye(4), [])


def _turn(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _turned(q: Floats, angles: Floats) -> Floats:
    """(2, K, N) points (N, 2), turned by each of K angles."""
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    return np.stack([c * q[:, 0] - s * q[:, 1], s * q[:, 0] + c * q[:, 1]])


@dataclass(frozen=True)
class Slack:
    """How far outside the outline a return may lie.

    Attributes:
        sigma: standard deviation of each return's own, metres.
        offset: standard deviation of what the returns along an edge share, metres: half of its variance is common to
            all edges, as if the target were larger or smaller, and half an edge's own.
        stray: share of returns that may lie anywhere.
    """

    sigma: float
    offset: float
    stray: float

    @classmethod
    def of(cls, evidence: Evidence) -> Slack:
        """Take the sensor's beam at the returns' median range."""
        beam, options = evidence.problem.beam, evidence.problem.options
        distance = np.median(np.linalg.norm(evidence.scan.points, axis=1))
        width = float(beam.width(distance))
        offset = float(np.hypot(beam.common * width, beam.blooming * distance))
        return cls(float(np.hypot(options.flatness, beam.OWN * width)), offset, options.strays)


@dataclass(frozen=True, eq=False, repr=False)
class Containment(Value):
    """The posterior over one connected set of poses: y = C(angle) q + t for q in the plane of the returns.

    Attributes:
        mean: (3,) angle, rad, and t, metres.
        covariance: (3, 3) matrix of the same.
        log_mass: logarithm of the integral of the likelihood over the set, rad m2.
    """

    mean: Floats
    covariance: Floats
    log_mass: float


def containing_poses(q: Floats, slack: Slack, target: Target) -> list[Containment]:
    """Find every connected set of poses in which a target contains returns.

    Args:
        q: (N, 2) returns in their plane, metres; the axes are like the target's (y, z), the origin near their middle.
        slack: how far outside a return may lie.
        target: the template.

    Returns:
        One posterior for each set, the most likely first; none where no pose contains the returns. Poses that a
        symmetry of the target turns into another's are listed once.
    """
    strays = int(slack.stray * len(q))
    outer = q[_outermost(q, strays + 4)]
    room = _room(q, strays, target) + REACH * (slack.sigma + slack.offset)
    sets = [_posterior(outer, slack, target, arc, strays) for arc in _arcs(room, target)]
    return sorted(sets, key=lambda one: -one.log_mass)


def _outermost(q: Floats, count: int) -> Bools:
    """Mask (N,) of the returns among the `count` outermost in some direction: no others can lie outside."""
    count = min(count, len(q))
    along = np.column_stack([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)]) @ q.T
    rows = np.argpartition(along, len(q) - count, axis=1)[:, len(q) - count :]
    return np.isin(np.arange(len(q)), rows)


def _support(q: Floats, angles: Floats, strays: int, target: Target) -> Floats:
    """(K, n) how far the returns, turned by each angle, reach along each edge's normal, `strays` of them left out."""
    along = np.einsum("ne,ekm->knm", target.normals, _turned(q, angles))
    return np.asarray(np.partition(along, len(q) - 1 - strays, axis=2)[:, :, len(q) - 1 - strays])


def _room(q: Floats, strays: int, target: Target) -> Floats:
    """(K,) at each angle, the largest distance from every edge that some translation keeps all returns at, metres.

    max r subject to n_k . t + r <= c_k - h_k: by duality the least of the sums of c - h weighed with the vertices of
    {w >= 0, sum w n = 0, sum w = 1}, which do not depend on the angle. Negative where the target is too small.
    """
    outer = q[_outermost(q, strays + 1)]
    b = target.offsets - _support(outer, _ANGLES, strays, target)
    return np.asarray((b @ np.array(_balances(target.normals)).T).min(axis=1))


def _balances(normals: Floats) -> list[Floats]:
    """Vertices of {w >= 0, sum w n = 0, sum w = 1}: two opposite normals, or three around a point."""
    found = []
    for size in (2, 3):
        for chosen in combinations(range(len(normals)), size):
            rows = np.vstack([normals[list(chosen)].T, np.ones(size)])
            w, *_ = np.linalg.lstsq(rows, [0.0, 0.0, 1.0], rcond=None)
            if w.min() > 1e-9 and np.abs(rows @ w - [0.0, 0.0, 1.0]).max() < 1e-9:
                found.append(np.zeros(len(normals)))
                found[-1][list(chosen)] = w
    return found


def _arcs(room: Floats, target: Target) -> list[tuple[float, float]]:
    """Runs of angles with room, (first, last), rad; of those alike by a symmetry, the one nearest to upright."""
    period = 2 * np.pi / len(target.symmetries)
    open_ = room > 0
    if open_.all():
        return [(-period / 2, period / 2)]
    start = int(np.argmin(open_))  # begin where there is no room, so that no run is cut in two
    turned = np.roll(open_, -start)
    edges = np.flatnonzero(np.diff(turned.astype(int), append=0))
    step = _ANGLES[1] - _ANGLES[0]
    runs = [
        ((start + first + 1 - 0.5) * step, (start + last + 0.5) * step)
        for first, last in zip(edges[::2], edges[1::2], strict=True)
    ]
    middles = [np.angle(np.exp(1j * (first + last) / 2)) for first, last in runs]
    return [
        (middle - (last - first) / 2, middle + (last - first) / 2)
        for middle, (first, last) in zip(middles, runs, strict=True)
        if -period / 2 - 1e-9 < middle <= period / 2 + 1e-9 or len(target.symmetries) == 1
    ]


def _posterior(outer: Floats, slack: Slack, target: Target, arc: tuple[float, float], strays: int) -> Containment:
    """Integrate the likelihood over one set of poses: once to find where it lies, once where it does.

    The offset that all edges share is none, or as much as it takes for the returns to fit in at all; those of each edge
    enter by sigma points, a second integral at each.
    """
    angles = np.linspace(*arc, _GRID[0])
    support = _support(outer, angles, strays, target)
    common = max(0.0, -float(((target.offsets - support) @ np.array(_balances(target.normals)).T).min(axis=1).max()))
    low, high = _bounding_box(target.offsets + common - support + REACH * slack.sigma, target.normals)
    share = slack.offset / np.sqrt(2)

    def moments(shift: Floats | float) -> Containment:
        return _moments(outer, slack, target.normals, target.offsets + shift, angles, low, high)

    coarse = moments(common)
    n = len(target)
    half = _SPAN * np.sqrt(np.diag(coarse.covariance) + np.array([1 / target.circumradius, 1.0, 1.0]) ** 2 * share**2)
    half[0] = min(half[0], np.pi / len(target.symmetries))
    angles = coarse.mean[0] + np.linspace(-half[0], half[0], _GRID[0])
    box = np.broadcast_to(half[1:], (len(angles), 2))
    moved = np.hypot(*half[1:]) + half[0] * np.linalg.norm(outer, axis=1) + REACH * slack.offset * np.sqrt(n)
    outside = target.outside_distance(outer @ _turn(coarse.mean[0]).T + coarse.mean[1:])
    outer = outer[outside + moved > -_CERTAIN * slack.sigma]  # the others are inside at every pose
    low, high = coarse.mean[1:] - box, coarse.mean[1:] + box
    shifts = share * np.sqrt(n) * np.vstack([np.eye(n), -np.eye(n)])
    mixed = _mixture([moments(common + shift) for shift in shifts])
    return replace(mixed, log_mass=mixed.log_mass - 0.5 * (common / share) ** 2)


def _mixture(parts: list[Containment]) -> Containment:
    """One Gaussian for equally likely ones, whatever their masses: offsets are no more likely for a tight outline."""
    means, covariances = np.array([one.mean for one in parts]), np.array([one.covariance for one in parts])
    mean = means.mean(axis=0)
    off = means - mean
    log_mass = float(np.logaddexp.reduce([one.log_mass for one in parts]) - np.log(len(parts)))
    return Containment(mean, covariances.mean(axis=0) + off.T @ off / len(parts), log_mass)


def _bounding_box(b: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Smallest and largest t (K, 2), (K, 2) with n_k . t <= b_k, from the corners where two of them meet."""
    i, j = np.array(list(combinations(range(len(normals)), 2))).T
    determinant = normals[i, 0] * normals[j, 1] - normals[i, 1] * normals[j, 0]
    crossing = np.abs(determinant) > 1e-9
    i, j, determinant = i[crossing], j[crossing], determinant[crossing]
    corner = np.stack([
        (b[:, i] * normals[j, 1] - b[:, j] * normals[i, 1]) / determinant,
        (b[:, j] * normals[i, 0] - b[:, i] * normals[j, 0]) / determinant,
    ], axis=-1)  # fmt: skip
    inside = np.asarray((corner @ normals.T <= b[:, None] + 1e-9).all(axis=-1))[..., None]
    low = np.where(inside, corner, np.inf).min(axis=1)
    high = np.where(inside, corner, -np.inf).max(axis=1)
    empty = ~(low <= high).all(axis=1)  # an angle at the end of the arc: its translations are those beside it
    if empty.all():
        low, high = np.median(corner, axis=1), np.median(corner, axis=1)
    else:
        nearest = np.abs(np.arange(len(b))[:, None] - np.flatnonzero(~empty)).argmin(axis=1)
        low, high = low[np.flatnonzero(~empty)[nearest]], high[np.flatnonzero(~empty)[nearest]]
    return low, high


def _moments(
    outer: Floats, slack: Slack, normals: Floats, offsets: Floats, angles: Floats, low: Floats, high: Floats
) -> Containment:
    """Mass, mean and covariance of the likelihood on a grid: angles (K,), and translations between low and high."""
    from scipy.special import ndtr  # of a million numbers: its import is worth it

    fractions = [(np.arange(n) + 0.5) / n for n in _GRID[1:]]
    cells = np.stack(np.meshgrid(*fractions, indexing="ij"), axis=-1).reshape(-1, 2)
    t = low[:, None] + cells * (high - low)[:, None]
    turned = _turned(outer, angles)
    outside = np.full((len(angles), len(cells), len(outer)), -np.inf)
    for n, offset in zip(normals, offsets, strict=True):
        along = np.einsum("e,ekm->km", n, turned) - offset
        np.maximum(outside, (t @ n)[..., None] + along[:, None], out=outside)
    log_inside = np.zeros(outside.shape)
    near = outside > -_CERTAIN * slack.sigma
    log_inside[near] = np.log(slack.stray + (1.0 - slack.stray) * ndtr(-outside[near] / slack.sigma))
    log_cell = np.log(np.maximum(np.prod(high - low, axis=1), 1e-18))[:, None]
    log_weight = log_inside.sum(axis=-1) + log_cell
    top = float(log_weight.max())
    weight = np.exp(log_weight - top)
    total = float(weight.sum())
    x = np.concatenate([np.broadcast_to(angles[:, None, None], (*t.shape[:2], 1)), t], axis=-1)
    mean = np.einsum("kc,kcd->d", weight, x) / total
    off = x - mean
    covariance = np.einsum("kc,kcd,kce->de", weight, off, off) / total
    log_volume = np.log(angles[1] - angles[0]) - np.log(len(cells))
    return Containment(mean, covariance, top + float(np.log(total)) + float(log_volume))
