"""Identify the target that a surface is: fit each target of its size, drop what does not fit, take the likeliest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.detection.candidates import Candidate, Size
from optshape_graph.detection.judge import edge_margin, judge, objections, outline_error, returns_of, undoubted
from optshape_graph.detection.options import DetectionOptions
from optshape_graph.detection.outline import Boundary, OutlineFit, first_looks, look_again, rectangle_log_odds
from optshape_graph.detection.results import Detection, Evidence, Rejection
from optshape_graph.detection.segments import Borders, OrderedScan, find_borders, find_runs
from optshape_graph.errors import EstimationError
from optshape_graph.pose import PoseEstimate, estimate_poses
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class Surface(Value):
    """A surface of a scan, and the targets that it may be.

    Attributes:
        ordered: the scan.
        candidate: the surface.
        targets: those that are looked for.
        sizes: of each.
    """

    ordered: OrderedScan
    candidate: Candidate
    targets: tuple[Target, ...]
    sizes: tuple[Size, ...]


@dataclass(frozen=True, eq=False, repr=False)
class _Fit(Value):
    """A target fitted to a surface.

    Attributes:
        rows: of the ordered scan, its returns.
        ends: of these, at which rings begin, then those at which they end.
        estimate: its pose, in the frame of the returns from which it was estimated.
        placed: the same in the scan's frame.
        evidence: for it.
    """

    rows: Ints
    ends: Ints
    estimate: PoseEstimate
    placed: PoseEstimate
    evidence: Evidence


@dataclass(frozen=True)
class _Misfit:
    """The reason why a candidate is not a target, and how many tests it passed before."""

    reason: str
    passed: int


TargetFits = Sequence[tuple[Target, _Fit | _Misfit]]
"""Of a surface: the targets that it may be, and how they fit, or why they do not."""

PASSED_AT_FIRST = 3
"""Number of tests before a target's outline is laid over a candidate: size, number of rings, and their ends."""

_LOOK_SD = 0.005  # standard deviation of a place that a first look finds, metres


def identify(surface: Surface, fitted: TargetFits) -> tuple[Detection | None, list[Rejection]]:
    """Find the target that a surface is.

    Args:
        surface: of a scan.
        fitted: the targets that it may be, and how they fit; see `fit_targets`.

    Returns:
        The detection, if any, and the reasons why the surface is not one of the other targets.
    """
    ordered, candidate = surface.ordered, surface.candidate
    fits: list[_Fit] = []
    rejected: list[Rejection] = []
    for target, fit in fitted:
        if isinstance(fit, _Misfit):
            rejected.append(rejection(candidate, fit.reason, fit.passed, target.name))
        else:
            fits.append(fit)
    if not fits:
        return None, rejected
    fits = [fit for fit in fits if fit.estimate.status != "doubtful"] or fits
    likelihoods = _likelihoods(ordered, fits)
    order = np.argsort(-likelihoods, kind="stable")
    best = fits[order[0]]
    rival = fits[order[1]].estimate.target if len(fits) > 1 else None
    margin = float(likelihoods[order[0]] - likelihoods[order[1]]) if len(fits) > 1 else np.inf
    status, reason = best.estimate.status, best.estimate.reason
    share = np.exp(likelihoods[order] - np.logaddexp.reduce(likelihoods))
    probabilities = {fits[k].estimate.target.name: float(p) for k, p in zip(order, share, strict=True)}
    options = ordered.options
    unsure = objections(best.evidence, options.sure_evidence)
    if status == "ok" and unsure:
        status, reason = "ambiguous", f"it may be something else: {unsure[0]}"
    if rival is not None and margin < options.pose.ambiguity_margin:
        likely = ", ".join(f"'{name}' {100 * p:.2g} %" for name, p in probabilities.items() if p > 1e-3)
        status, reason = "ambiguous", f"its returns do not tell the targets apart: {likely}"
    rows = best.rows[np.argsort(ordered.index[best.rows])]
    doubtful = ~undoubted(ordered, best.placed, rows)
    target = best.estimate.target
    found = Detection(
        target,
        best.estimate,
        ordered.index[rows],
        doubtful,
        best.evidence,
        rival,
        margin,
        probabilities,
        status,
        reason,
    )
    return found, rejected


def rejection(candidate: Candidate, reason: str, passed: int, target: str = "") -> Rejection:
    """Return the record of a candidate that is not a target, or none of the targets."""
    return Rejection(
        reason=reason,
        passed=passed,
        target=target,
        centre=candidate.plane.centre,
        n_returns=len(candidate.rows),
        n_rings=candidate.n_rings,
        area=candidate.area,
    )


def _first_looks(surfaces: Sequence[Surface]) -> list[OutlineFit | _Misfit]:
    """Lay the outline of each target over each surface in turn, and reject those that cannot be it."""
    problems = [[size.objection(one.candidate, one.ordered.options) for size in one.sizes] for one in surfaces]
    laid = [
        (Boundary.of(one.ordered, one.candidate.ends, one.candidate.plane), one.candidate.centroid, target)
        for one, of_size in zip(surfaces, problems, strict=True)
        for target, problem in zip(one.targets, of_size, strict=True)
        if not problem
    ]
    fits = iter(first_looks([one[0] for one in laid], [one[1] for one in laid], [one[2] for one in laid]))
    looks: list[OutlineFit | _Misfit] = []
    for one, of_size in zip(surfaces, problems, strict=True):
        own = [_Misfit(problem, 0) if problem else next(fits) for problem in of_size]
        best = max((look.log_odds for look in own if isinstance(look, OutlineFit)), default=0.0)
        options = one.ordered.options
        looks += [look if isinstance(look, _Misfit) else _worth_a_pose(look, best, options) for look in own]
    return looks


def _worth_a_pose(look: OutlineFit, best: float, options: DetectionOptions) -> OutlineFit | _Misfit:
    """Turn a first look down that fits too few ring ends, or far worse than another target's, of log odds `best`."""
    if look.edged < options.first_look:
        reason = f"at a first look only {look.edged:.0%} of the ends of its rings lie on its outline"
    elif look.log_odds < best - options.first_look_odds:
        reason = f"at a first look another of the targets fits better (log odds {best:.0f} against {look.log_odds:.0f})"
    else:
        return look
    return _Misfit(reason, PASSED_AT_FIRST)


@dataclass(frozen=True, eq=False, repr=False)
class _Suspect(Value):
    """A target that a surface may be, whose pose is asked for.

    Attributes:
        surface: the surface.
        target: the target.
        T_lidar_target: (4, 4) of the outline by which its returns were chosen.
        rows: (N,) of the ordered scan, taken for the target's returns.
        ends: (2 M,) of these, at which rings begin, then those at which they end.
    """

    surface: Surface
    target: Target
    T_lidar_target: Floats
    rows: Ints
    ends: Ints


def fit_targets(surfaces: Sequence[Surface]) -> list[TargetFits]:
    """Fit targets to surfaces that they may be, all of them at once.

    Args:
        surfaces: of any scans, all searched with the same options.

    Returns:
        For each surface its targets, and how they fit or why not.
    """
    looks = _first_looks(surfaces)
    asked = [(surface, target) for surface in surfaces for target in surface.targets]
    laid = [(*pair, look) for pair, look in zip(asked, looks, strict=True) if isinstance(look, OutlineFit)]
    suspects = iter(_suspects(laid))
    chosen = [look if isinstance(look, _Misfit) else next(suspects) for look in looks]
    posed = iter(_posed([one for one in chosen if isinstance(one, _Suspect)]))
    fits = iter(next(posed) if isinstance(one, _Suspect) else one for one in chosen)
    return [[(target, next(fits)) for target in surface.targets] for surface in surfaces]


def _suspects(laid: Sequence[tuple[Surface, Target, OutlineFit]]) -> list[_Suspect | _Misfit]:
    """Choose targets' returns by their outlines, until their rings end where they did.

    Args:
        laid: targets over surfaces, and where at a first look.
    """
    found = [_suspect(*of_one) for of_one in laid]
    unsettled = [k for k, suspect in enumerate(found) if len(suspect.rows)]
    for _ in range(_rounds(found)):
        some = [found[k] for k in unsettled]
        looks = look_again(
            [_boundary(suspect, find_borders(suspect.surface.ordered, suspect.ends)) for suspect in some],
            [suspect.target for suspect in some],
            [suspect.T_lidar_target for suspect in some],
        )
        again = [_suspect(one.surface, one.target, look) for one, look in zip(some, looks, strict=True)]
        for k, now in zip(unsettled, again, strict=True):
            found[k] = now
        unsettled = [
            k
            for k, before, now in zip(unsettled, some, again, strict=True)
            if len(now.rows) and not np.array_equal(before.ends, now.ends)
        ]
    none = _Misfit("none of its returns lies inside the outline laid over it", PASSED_AT_FIRST + 1)
    return [suspect if len(suspect.rows) else none for suspect in found]


def _rounds(suspects: Sequence[_Suspect]) -> int:
    return max((suspect.surface.ordered.options.rounds for suspect in suspects), default=0)


def _suspect(surface: Surface, target: Target, look: OutlineFit) -> _Suspect:
    """Choose a target's returns: those inside an outline laid over it, and outside it as far as the target blooms."""
    ordered = surface.ordered
    margin = edge_margin(ordered, target, look.T_lidar_target, _LOOK_SD)
    rows = returns_of(ordered, target, look.T_lidar_target, margin)
    return _Suspect(surface, target, look.T_lidar_target, rows, find_runs(ordered, rows).ends)


def _boundary(suspect: _Suspect, borders: Borders) -> Boundary:
    surface = suspect.surface
    return Boundary.of(surface.ordered, suspect.ends, surface.candidate.plane, borders.hidden)


def _posed(suspects: Sequence[_Suspect]) -> list[_Fit | _Misfit]:
    """Estimate the poses of suspects, all at once, and judge them.

    Near a rim that blooms, what a pose that fails takes for the target's own may suit it better: those are tried again.
    """
    found: dict[int, _Misfit] = {}
    posed: dict[int, _Posed] = {}
    left = dict(enumerate(suspects))
    for number in reversed(range(max(_rounds(suspects), 1))):
        if not left:
            break
        options = suspects[0].surface.ordered.options.pose
        returns, frames = zip(*[one.surface.ordered.returns(one.rows) for one in left.values()], strict=True)
        estimates = estimate_poses(returns, [suspect.target for suspect in left.values()], options=options)
        again: dict[int, _Suspect] = {}
        for (k, suspect), estimate, T in zip(left.items(), estimates, frames, strict=True):
            ordered = suspect.surface.ordered
            if isinstance(estimate, EstimationError):
                found[k] = _Misfit(str(estimate), PASSED_AT_FIRST + 1)
                continue
            moved = suspect.surface.ordered.fired is not None
            placed = replace(estimate, T_lidar_target=T @ estimate.T_lidar_target) if moved else estimate
            margin = edge_margin(ordered, suspect.target, placed.T_lidar_target, outline_error(placed))
            # A pose that is not determined is no objection to the target being there.
            if estimate.status == "failed" and not estimate.unobservable:
                rows = returns_of(ordered, suspect.target, placed.T_lidar_target, margin)
                if number and len(rows) and not np.array_equal(rows, suspect.rows):
                    again[k] = replace(suspect, rows=rows, ends=find_runs(ordered, rows).ends)
                found[k] = _Misfit(estimate.reason, PASSED_AT_FIRST + 1)
            else:
                posed[k] = _Posed(suspect, estimate, placed, margin)
        left = again
    judged: dict[int, _Fit | _Misfit] = dict(zip(posed, _judged(list(posed.values())), strict=True))
    return [(found | judged)[k] for k in range(len(suspects))]


class _Posed(NamedTuple):
    """A suspect, its pose, the same in the scan's frame, and how far outside its outline a return may lie, metres."""

    suspect: _Suspect
    estimate: PoseEstimate
    placed: PoseEstimate
    margin: float


def _judged(posed: Sequence[_Posed]) -> list[_Fit | _Misfit]:
    """Ask all rays about poses."""
    borders = [find_borders(one.suspect.surface.ordered, one.suspect.ends) for one in posed]
    boundaries = [_boundary(one.suspect, own) for one, own in zip(posed, borders, strict=True)]
    targets = [one.suspect.target for one in posed]
    looks = look_again(boundaries, targets, [one.placed.T_lidar_target for one in posed])
    rectangles = rectangle_log_odds(boundaries, np.array([target.circumradius for target in targets]))
    fits: list[_Fit | _Misfit] = []
    for one, own, look, rectangle in zip(posed, borders, looks, rectangles, strict=True):
        surface = one.suspect.surface
        evidence = judge(surface.ordered, surface.candidate, own, look, float(rectangle), one.placed, one.margin)
        against = objections(evidence, surface.ordered.options.least_evidence)
        if against:
            fits.append(_Misfit("; ".join(against), PASSED_AT_FIRST + 2 + len(fields(evidence)) - len(against)))
        else:
            fits.append(_Fit(one.suspect.rows, one.suspect.ends, one.estimate, one.placed, evidence))
    return fits


def _likelihoods(ordered: OrderedScan, fits: Sequence[_Fit]) -> Floats:
    """Return the log likelihood of each fit, from the returns that all fits share."""
    if len(fits) == 1:
        return np.array([fits[0].estimate.log_likelihood])
    if all(np.array_equal(fit.ends, fits[0].ends) for fit in fits):
        return np.array([fit.estimate.log_likelihood for fit in fits])
    common = fits[0].rows
    for fit in fits[1:]:
        common = np.intersect1d(common, fit.rows)
    returns, _ = ordered.returns(common)
    again = estimate_poses([returns] * len(fits), [fit.estimate.target for fit in fits], options=ordered.options.pose)
    return np.array([-np.inf if isinstance(one, EstimationError) else one.log_likelihood for one in again])
