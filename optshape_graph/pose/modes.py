"""Candidates for the pose: ranked, and gathered in modes, poses that are the same but for their uncertainty.

Expectation propagation takes the chords that rings cut out of the target for linear in the pose, and each ring to leave
by one given edge. With many rings that is as good as true, and the best mode leads the rest by far. Where it doesn't,
few rings meet the target and its orientation is known to some degrees only: modes are compared by numbers that are off
by several units of log likelihood, and their means by as much as their widths. So poses are drawn about all modes at
once, and each is weighed by the likelihood of the scan as it is. What is compared is the mass of modes, not their best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.edges import UP
from optshape_graph.errors import EstimationError
from optshape_graph.factors.static import OUTER_EDGE, SharedError, angle_errors
from optshape_graph.pose.association import enumerate_poses
from optshape_graph.pose.ends import (
    Posterior,
    alternative_labels,
    concatenate,
    firsts,
    work_out,
)
from optshape_graph.pose.evidence import Evidence, ends_of
from optshape_graph.pose.sampling import Components, Firings, LogDensity, Rays, SampledPose, Samples, sample
from optshape_graph.se3 import adjoint, apply, cross, difference, exp, inverse, vec, vec_derivative
from optshape_graph.sensor import SensorModel, angle_sds, total_angle_sds
from optshape_graph.target import Target

AT_ONCE = 480
"""Ring ends of the scans that are worked on at once: more, and their candidates' arrays don't stay in cache."""

ALTERNATIVES = 6
"""How many associations next to the best take part in the estimate."""

TURNS, GAIN = 3, 0.5
"""How often associations next to the best are worked out at most, and the gain of log likelihood below which they are
not again."""

SURE = (6, 15.0)
"""Rings, and lead of the best mode by its associations, at which no poses need be drawn: they never disagreed there."""

KNOWN = np.radians(0.02)
"""Standard deviation of a ring's own direction, rad, below which every ray counts, not just the ends of rings: what the
rays between and beside tell would otherwise be hidden by how far off the rings look, and shared by scans of a scene."""

COMPETING = 50.0
"""Difference of log likelihoods by association from which on a mode is not in the running."""

MOST_MODES = 12
"""Components about which poses are drawn at first."""

APART = (np.radians(3.0), 0.03)
"""Angle, rad, and distance, target radii, by which their means differ at least: either."""

MODE = (np.radians(25.0), 0.35)
"""Angle, rad, and distance, target radii, from a mode's pose within which poses belong to it: both."""

ITSELF = np.eye(4)[None]
"""The symmetry that every target has."""

WIDENING = 1.3
"""Of the posteriors' standard deviations, where poses are drawn."""

BROAD = (0.25, 0.05)
"""Standard deviations, rad and target radii, that broader components add to turns and shifts in the plane."""

TRUSTED = 50.0
"""Effective samples below which samples settle nothing."""

NOTHING = 1e-12
"""Weight of a sample over the largest below which it doesn't count."""

ASKED = 256
"""Samples that are asked on which edge each ring ends."""


@dataclass(frozen=True, eq=False, repr=False)
class Modes(Value):
    """The best mode, and what else it might be.

    Attributes:
        candidates: best first; those of the best mode before all others.
        best: (C,) whether each is of the best mode, its vertices named as the first's are.
        margin: logarithm of the best mode's probability over that of all other poses together; infinite where there is
            no other.
        rival: (4, 4) T_lidar_target of the likeliest other mode, or None.
        sampled: the best mode by samples; None where they were not needed, or settle nothing.
    """

    candidates: Posterior
    best: Bools
    margin: float = np.inf
    rival: Floats | None = None
    sampled: SampledPose | None = None

    @property
    def weights(self) -> Floats:
        """(C,) probability of each association, within the best mode; those below a thousandth count as 0."""
        score = self.candidates.log_likelihood
        weight = np.where(self.best, np.exp(np.minimum(score - score[0], 0.0)), 0.0)
        weight[weight < 1e-3] = 0.0
        return np.asarray(weight / weight.sum())

    @property
    def log_likelihood(self) -> float:
        """Log likelihood of the best mode, all its associations together."""
        return float(np.logaddexp.reduce(self.candidates.log_likelihood[self.best]))


def find_candidates(evidences: Sequence[Evidence]) -> list[Posterior]:
    """Find the posterior of the pose under every association that is worth it, likeliest first, each once, by scan.

    Every consistent association of ring ends to edges gives a start. A first round tells the starts apart. A second
    works out the best, the associations next to it, the one that its own pose has, and the poses that the target's
    shape takes for it: half a turn, and those that bring it nearest to itself. Where one of these is better, the same
    is done about it.

    Args:
        evidences: of scans with rings, in any number, each with its target.
    """
    order = sorted(
        range(len(evidences)), key=lambda k: (len(evidences[k].problem.target), len(evidences[k].bounded.edges))
    )
    found: dict[int, Posterior] = {}
    for some in _batches([evidences[k] for k in order]):
        together = [order[k] for k in some]
        found.update(zip(together, _find_together([evidences[k] for k in together]), strict=True))
    return [found[k] for k in range(len(evidences))]


def _batches(evidences: Sequence[Evidence]) -> list[list[int]]:
    """Group neighbours whose targets have as many edges, up to AT_ONCE ring ends in each group."""
    groups: list[list[int]] = []
    for k, evidence in enumerate(evidences):
        ends, n = len(evidence.bounded.edges), len(evidence.problem.target)
        last = evidences[groups[-1][0]] if groups else evidence
        if groups and n == len(last.problem.target) and (len(groups[-1]) + 1) * ends <= AT_ONCE:
            groups[-1].append(k)
        else:
            groups.append([k])
    return groups


def _find_together(evidences: Sequence[Evidence]) -> list[Posterior]:
    """Find the candidates of scans whose targets have as many edges; see `find_candidates`."""
    targets, ends = [evidence.problem.target for evidence in evidences], ends_of(evidences)
    starts = enumerate_poses([one.problem.edges for one in evidences], [one.plane for one in evidences], targets)
    T = [_upright(poses, target) for poses, target in zip(starts, targets, strict=True)]
    scan, first = work_out(ends, _scan_of(T), np.concatenate(T), None, sweeps=2)
    every, found, improved = np.arange(len(targets)), first, np.arange(len(targets))
    for turn in range(TURNS):
        best = found.select(_best(scan, found, improved))
        T, labels = [], []
        beside = alternative_labels(ends.take(improved), best, ALTERNATIVES)
        for k, target in enumerate([targets[of] for of in improved]):
            pose, own = best.T_target_lidar[k : k + 1], np.vstack([best.geometry.labels[k], beside[k]])
            free = np.concatenate([pose, _upright(target.lookalike_transforms @ pose, target)]) if turn == 0 else pose
            T.append(np.concatenate([np.repeat(pose, len(own), axis=0), free]))
            labels.append(np.vstack([own, np.full((len(free), own.shape[1]), -1)]))  # a pose's labels are its own
        again, more = work_out(ends, improved[_scan_of(T)], np.concatenate(T), np.concatenate(labels), sweeps=4)
        itself = more.log_likelihood[np.searchsorted(again, improved)]
        gain = more.log_likelihood[_best(again, more, improved)] - itself
        scan, found = np.concatenate([again, scan]), concatenate([more, found])
        improved = improved[gain > GAIN]
        if not len(improved):
            break
    once = firsts(scan, found.geometry.labels)
    order = once[np.lexsort((-found.log_likelihood[once], scan[once]))]
    bounds = np.searchsorted(scan[order], np.append(every, len(every))).tolist()
    return [
        found.select(order[a:b], len(evidence.bounded.edges))
        for (a, b), evidence in zip(pairwise(bounds), evidences, strict=True)
    ]


def _best(scan: Ints, found: Posterior, wanted: Ints) -> Ints:
    """Index (K,) of the likeliest of the posteriors of scans (C,) in each of some scans (K,)."""
    order = np.lexsort((-found.log_likelihood, scan))
    return order[np.searchsorted(scan[order], wanted)]


def _scan_of(of_scans: Sequence[Floats]) -> Ints:
    """(C,) number of the scan that each row of arrays, one of each scan, is of."""
    return np.repeat(np.arange(len(of_scans)), [len(one) for one in of_scans])


def _upright(T: Floats, target: Target) -> Floats:
    """Turn poses (C, 4, 4) by the target's symmetries so that its z axis is as nearly up as it gets."""
    turned = inverse(target.symmetry_transforms) @ T[:, None]  # (T_lidar_target S)^-1 = S^-1 T_target_lidar
    return np.asarray(turned[np.arange(len(T)), turned[:, :, 2, 2].argmax(axis=1)])


def compare_modes(candidates: Posterior, evidence: Evidence) -> Modes:
    """Gather candidates in modes, and compare the best with all others.

    Args:
        candidates: best first.
        evidence: in which they were found.

    Raises:
        EstimationError: no pose explains the returns.
    """
    target = evidence.problem.target
    if not np.isfinite(candidates.log_likelihood[0]):
        raise EstimationError(f"{evidence.scan.name}: no pose explains the returns")
    by_association = _compare(candidates, target)
    sure = evidence.problem.edges.n_rings >= SURE[0] and by_association.margin > SURE[1]
    if sure and not _every_ray_counts(evidence):
        return by_association
    chosen = candidates.select(np.array(_apart(candidates, target)))
    density = scan_log_likelihood(evidence)
    components = _components(chosen, evidence.scan.points.mean(axis=0), target.circumradius)
    samples = sample(density, components, target.symmetry_transforms, np.random.default_rng(0))
    poses = inverse(chosen.T_target_lidar)
    mass = np.array([samples.weight[same_mode(samples.T, T, target)].sum() for T in poses])
    first = poses[mass.argmax()]
    of_first = same_mode(samples.T, first, target)
    elsewhere = float(samples.weight[~of_first].sum())
    with np.errstate(divide="ignore"):
        margin = float(np.log(mass.max()) - np.log(elsewhere))
    if samples.effective < TRUSTED:
        margin = min(margin, float(np.log(samples.effective)))
    others = ~same_mode(poses, first, target)
    rival = poses[np.where(others, mass, -1.0).argmax()] if others.any() else None
    best = _within(inverse(candidates.T_target_lidar), first, MODE, ITSELF, target.circumradius)
    order = np.argsort(~best, kind="stable")
    inside = Samples(samples.T[of_first], samples.scalar[of_first], samples.weight[of_first], samples.log_integral)
    sampled = _moments(inside, first, evidence) if inside.effective > TRUSTED else None
    return Modes(candidates.select(order), best[order], margin, rival, sampled)


def _every_ray_counts(evidence: Evidence) -> bool:
    """Whether the rings' directions are known, by calibration, so well that their ends are too little of a scan."""
    sensor = evidence.problem.sensor
    if sensor is None or not sensor.calibrated:
        return False
    up, left = angle_sds(sensor, evidence.problem.edges.ring)
    return bool(np.median(np.hypot(up, left)) < KNOWN)


def scan_log_likelihood(evidence: Evidence) -> LogDensity:
    """Return the logarithm of the likelihood of a scan, up to a constant, as a function of pose and common offset.

    Args:
        evidence: of a scan with rings.

    Returns:
        A function of T_lidar_target (S, 4, 4) and of the offset across the edges (S,), in beam widths.
    """
    scan, problem = evidence.scan, evidence.problem
    ends, beam, target, options, form = problem.edges, problem.beam, problem.target, problem.options, problem.plane
    ranges = np.linalg.norm(ends.points[::2], axis=1)
    common = beam.offset_of_rays(ranges)
    rays: Firings | Rays
    if beam.ideal and not ends.scatter.any():
        rays = Firings.of(scan, ends, options.flatness, options.lost_ends_of_rays, options.lost_span)
    else:
        odd_ends = scan.sensor.odd_ends if scan.sensor else SensorModel.odd_ends
        up, left = total_angle_sds(scan.sensor, ends.ring[::2])
        off = np.sqrt(0.5 * (up**2 + left**2))
        rays = Rays.of(scan, ends, beam.width(ranges) / ranges, off, 2 * target.circumradius, odd_ends)

    def log_likelihood(T_lidar_target: Floats, offset: Floats) -> Floats:
        z = vec(inverse(T_lidar_target))
        on_plane = -0.5 * (((z @ form[:12, :12] + 2 * form[12, :12]) * z).sum(axis=-1) + form[12, 12])
        corners = apply(T_lidar_target, target.vertices)
        return np.asarray(on_plane - 0.5 * (offset / common) ** 2 + rays.log_likelihood(corners, offset + beam.offset))

    return log_likelihood


def _compare(candidates: Posterior, target: Target) -> Modes:
    """Take the likelihoods of the associations for what they are; the rival is the best outside the best's mode."""
    poses, score = inverse(candidates.T_target_lidar), candidates.log_likelihood
    best, others = _within(poses, poses[0], MODE, ITSELF, target.circumradius), ~same_mode(poses, poses[0], target)
    order = np.argsort(~best, kind="stable")
    gathered = Modes(candidates.select(order), best[order])
    if not others.any():
        return gathered
    margin = float(np.logaddexp.reduce(score[best]) - np.logaddexp.reduce(score[others]))
    return replace(gathered, margin=margin, rival=poses[np.where(others, score, -np.inf).argmax()])


def same_mode(T: Floats, first: Floats, target: Target) -> Bools:
    """(S,) whether poses T_lidar_target (S, 4, 4) belong to the mode of a first (4, 4), or of its equivalents."""
    return _within(T, first, MODE, target.symmetry_transforms, target.circumradius)


def _within(T: Floats, first: Floats, limits: tuple[float, float], symmetries: Floats, size: float) -> Bools:
    """(S,) whether poses, or their equivalents, are turned and moved by less than limits, rad and sizes."""
    equivalent = first[:3, :3] @ np.swapaxes(symmetries[:, :3, :3], 1, 2)
    # The trace of a rotation by x is 1 + 2 cos x.
    trace = (T[:, :3, :3].reshape(-1, 9) @ equivalent.reshape(-1, 9).T).max(axis=1)
    moved = T[:, :3, 3] - first[:3, 3]
    near = np.vecdot(moved, moved) < (limits[1] * size) ** 2
    return np.asarray((trace > 1.0 + 2.0 * np.cos(limits[0])) & near)


def _apart(candidates: Posterior, target: Target) -> list[int]:
    """Candidates that are in the running, and differ."""
    poses, score = inverse(candidates.T_target_lidar), candidates.log_likelihood
    chosen: list[int] = []
    for k in np.argsort(-score, kind="stable"):
        if len(chosen) == MOST_MODES or score[k] < score.max() - COMPETING:
            break
        if not chosen or not any(_within(poses[chosen], poses[k], APART, ITSELF, target.circumradius)):
            chosen.append(int(k))
    return chosen


def _components(posterior: Posterior, centre: Floats, size: float) -> Components:
    """Components to draw poses T_lidar_target from: about posteriors, and broader ones about the same.

    With two or three rings a target can often be turned about the middle of its returns, or shifted, much further than
    a posterior that is linear in the pose allows.

    Args:
        posterior: of C poses.
        centre: (3,) of the returns, LiDAR frame, metres.
        size: radius of the target, metres.
    """
    # (T Exp(xi))^-1 = T^-1 Exp(-Ad(T) xi)
    J = np.zeros((len(posterior.offset), 7, 7))
    J[:, :6, :6], J[:, 6, 6] = -adjoint(posterior.T_target_lidar), 1.0
    narrow = WIDENING**2 * J @ posterior.joint @ np.swapaxes(J, 1, 2)
    middle = apply(posterior.T_target_lidar, centre[None])[:, 0]
    turning = np.zeros((len(J), 7))
    turning[:, 0], turning[:, 3:6] = 1.0, cross(middle, np.array([1.0, 0.0, 0.0]))
    broad = narrow + BROAD[0] ** 2 * turning[:, :, None] * turning[:, None]
    broad[:, [4, 5], [4, 5]] += (BROAD[1] * size) ** 2
    likely = np.exp((posterior.log_likelihood - posterior.log_likelihood.max()) / 4)
    weight = 0.5 * likely / likely.sum() + 0.5 / len(likely)
    mean = np.zeros((len(J), 7))
    mean[:, 6] = posterior.offset
    return Components(
        np.tile(inverse(posterior.T_target_lidar), (2, 1, 1)),
        np.tile(mean, (2, 1)),
        np.concatenate([narrow, broad]),
        np.concatenate([0.75 * weight, 0.25 * weight]),
    )


def _moments(samples: Samples, first: Floats, evidence: Evidence) -> SampledPose:
    """Mean and covariance of samples of T_lidar_target about one of them, the target's equivalents being one."""
    counts = samples.weight > NOTHING * samples.weight.max()
    samples = replace(samples, T=samples.T[counts], scalar=samples.scalar[counts], weight=samples.weight[counts])
    weight = samples.weight / samples.weight.sum()
    poses = inverse(evidence.problem.target.nearest_equivalent(samples.T, first))
    mean = inverse(first)
    for _ in range(3):
        xi = difference(mean, poses)
        mean = mean @ exp(weight @ xi)
    offset = float(weight @ samples.scalar)
    off = np.column_stack([difference(mean, poses), samples.scalar - offset])
    equally = np.searchsorted(np.cumsum(weight), (np.arange(ASKED) + 0.5) / ASKED).clip(max=len(weight) - 1)
    errors, effect = _effects(evidence, poses[equally])
    return SampledPose(mean, offset, (weight[:, None] * off).T @ off, errors, effect)


def _effects(evidence: Evidence, T_target_lidar: Floats) -> tuple[tuple[SharedError, ...], Floats]:
    """Errors (K,) that scans share, and how far off the estimate the truth is for a standard deviation of each (7, K).

    Linear in pose and offset: rows J x + B a of weight W are least at x = -C J^T W B a, C being the covariance. Poses
    (S, 4, 4) that are equally likely don't agree where some rings end: the rows are theirs on average.
    """
    problem, T = evidence.bounded, T_target_lidar
    edges = problem.edges
    g = problem.geometry(T)
    weight = 1.0 / (g.own + g.along**2 * (edges.width**2 / 12 + edges.shift**2))
    m = g.direction @ T[:, :3, :3]
    J = np.concatenate([cross(edges.points, m), m, g.across[..., None]], axis=-1)
    D = vec_derivative(T)
    information = (np.swapaxes(J, 1, 2) @ (weight[..., None] * J)).mean(axis=0)
    information[:6, :6] += (np.swapaxes(D, 1, 2) @ problem.plane[:12, :12] @ D).mean(axis=0)
    information[6, 6] += 1.0 / problem.beam.offset_of_rays(np.linalg.norm(edges.points, axis=1)) ** 2
    none, whole = np.zeros(len(edges)), np.ones(len(edges))
    lifted, errors = angle_errors(whole, none, edges.ring, problem.sensor)
    turned, _ = angle_errors(none, whole, edges.ring, problem.sensor)
    outside = np.abs(edges.side) == UP
    between = np.abs(g.along) * edges.width / np.sqrt(12.0)
    by_lift, by_turn, by_outer = (((weight * by)[..., None] * J).mean(axis=0).T for by in (g.lifted, g.turned, between))
    pull = np.hstack([by_lift @ lifted + by_turn @ turned, by_outer[:, outside]])
    outer = tuple(SharedError(OUTER_EDGE, ring=int(ring)) for ring in edges.ring[outside])
    return (*errors, *outer), -np.linalg.solve(information, pull)
