"""Identify the target that a surface is: fit each target of its size, drop what does not fit, take the likeliest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.detection.candidates import Candidate, Size
from optshape_graph.detection.judge import edge_margin, judge, objections, outline_error, returns_of, undoubted
from optshape_graph.detection.outline import Boundary, OutlineFit, first_look, look_again
from optshape_graph.detection.results import Detection, Evidence, Rejection
from optshape_graph.detection.segments import OrderedScan, find_borders, ring_ends
from optshape_graph.errors import EstimationError
from optshape_graph.pose import PoseEstimate, estimate_poses
from optshape_graph.scan import Scan
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class _Fit(Value):
    """A target fitted to a candidate: the rows of the ordered scan that count as its returns, pose, evidence."""

    rows: Ints
    estimate: PoseEstimate
    evidence: Evidence


@dataclass(frozen=True)
class _Misfit:
    """The reason why a candidate is not a target, and how many tests it passed before."""

    reason: str
    passed: int


PASSED_AT_FIRST = 3
"""Number of tests before a target's outline is laid over a candidate: size, number of rings, and their ends."""

_LOOK_SD = 0.005  # standard deviation of a place that a first look finds, metres


def identify(
    scan: Scan, ordered: OrderedScan, candidate: Candidate, fitted: Sequence[tuple[Target, _Fit | _Misfit]]
) -> tuple[Detection | None, list[Rejection]]:
    """Find the target that a candidate is.

    Args:
        scan: the scan in which it was found.
        ordered: that scan, ordered.
        candidate: a surface.
        fitted: the targets that it may be, and how they fit; see `fit_targets`.

    Returns:
        The detection, if any, and the reasons why the candidate is not one of the other targets.
    """
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
    likelihoods = _likelihoods(scan, ordered, fits)
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
    doubtful = ~undoubted(ordered, best.estimate, rows)
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


def _first_looks(
    ordered: OrderedScan, candidate: Candidate, targets: Sequence[Target], sizes: Sequence[Size]
) -> list[OutlineFit | _Misfit]:
    """Lay the outline of each target over a candidate, and reject targets that cannot be it."""
    options, looks = ordered.options, list[OutlineFit | _Misfit]()
    boundary = Boundary.of(ordered, candidate.rows, candidate.plane)
    for target, size in zip(targets, sizes, strict=True):
        problem = size.objection(candidate, options)
        looks.append(_Misfit(problem, 0) if problem else first_look(boundary, candidate.centroid, target))
    best = max((look.log_odds for look in looks if isinstance(look, OutlineFit)), default=0.0)
    for k, look in enumerate(looks):
        if isinstance(look, _Misfit):
            continue
        if look.edged < options.first_look:
            reason = f"at a first look only {look.edged:.0%} of the ends of its rings lie on its outline"
            looks[k] = _Misfit(reason, PASSED_AT_FIRST)
        elif look.log_odds < best - options.first_look_odds:
            reason = (
                f"at a first look another of the targets fits better (log odds {best:.0f} against {look.log_odds:.0f})"
            )
            looks[k] = _Misfit(reason, PASSED_AT_FIRST)
    return looks


@dataclass(frozen=True, eq=False, repr=False)
class _Suspect(Value):
    """A target that a candidate may be, whose pose is asked for.

    Attributes:
        candidate: the surface.
        target: the target.
        rows: (N,) of the ordered scan, taken for the target's returns.
    """

    candidate: Candidate
    target: Target
    rows: Ints


def fit_targets(
    scan: Scan, ordered: OrderedScan, candidates: Sequence[Candidate], targets: Sequence[Target], sizes: Sequence[Size]
) -> list[list[tuple[Target, _Fit | _Misfit]]]:
    """Fit each target to each candidate that it may be, all poses at once.

    Args:
        scan: what they were found in.
        ordered: the same, ordered.
        candidates: surfaces.
        targets: those they may be.
        sizes: of each target.

    Returns:
        For each candidate the targets, and how they fit or why not.
    """
    asked = [
        (target, look if isinstance(look, _Misfit) else _suspect(ordered, candidate, look, target))
        for candidate in candidates
        for target, look in zip(targets, _first_looks(ordered, candidate, targets, sizes), strict=True)
    ]
    posed = iter(_posed(scan, ordered, [one for _, one in asked if isinstance(one, _Suspect)]))
    fits = [(target, next(posed) if isinstance(one, _Suspect) else one) for target, one in asked]
    return [fits[k : k + len(targets)] for k in range(0, len(fits), len(targets))]


def _suspect(ordered: OrderedScan, candidate: Candidate, look: OutlineFit, target: Target) -> _Suspect | _Misfit:
    """Choose a target's returns by its outline, until their rings end where they did."""
    rows = _returns_at(ordered, target, look)
    for _ in range(ordered.options.rounds):
        if len(rows) == 0:
            break
        ends, hidden = ring_ends(ordered, rows), find_borders(ordered, rows).hidden
        look = look_again(Boundary.of(ordered, rows, candidate.plane, hidden), target, look.T_lidar_target)
        rows = _returns_at(ordered, target, look)
        if np.array_equal(ring_ends(ordered, rows), ends):
            break
    if len(rows) == 0:
        return _Misfit("none of its returns lies inside the outline laid over it", PASSED_AT_FIRST + 1)
    return _Suspect(candidate, target, rows)


def _posed(scan: Scan, ordered: OrderedScan, suspects: Sequence[_Suspect]) -> list[_Fit | _Misfit]:
    """Estimate the poses of suspects, all at once, and judge them.

    Near a rim that blooms, what a pose that fails takes for the target's own may suit it better: those are tried again.
    """
    found: dict[int, _Fit | _Misfit] = {}
    left = dict(enumerate(suspects))
    for number in reversed(range(max(ordered.options.rounds, 1))):
        returns = [scan.select(ordered.index[suspect.rows]) for suspect in left.values()]
        wanted = [suspect.target for suspect in left.values()]
        estimates = estimate_poses(returns, wanted, options=ordered.options.pose)
        again: dict[int, _Suspect] = {}
        for (k, suspect), estimate in zip(left.items(), estimates, strict=True):
            if isinstance(estimate, EstimationError):
                found[k] = _Misfit(str(estimate), PASSED_AT_FIRST + 1)
                continue
            margin = edge_margin(ordered, suspect.target, estimate.T_lidar_target, outline_error(estimate))
            # A pose that is not determined is no objection to the target being there.
            if estimate.status == "failed" and not estimate.unobservable:
                rows = returns_of(ordered, suspect.target, estimate.T_lidar_target, margin)
                if number and len(rows) and not np.array_equal(rows, suspect.rows):
                    again[k] = replace(suspect, rows=rows)
                found[k] = _Misfit(estimate.reason, PASSED_AT_FIRST + 1)
            else:
                found[k] = _judged(ordered, suspect, estimate, margin)
        left = again
        if not left:
            break
    return [found[k] for k in range(len(suspects))]


def _judged(ordered: OrderedScan, suspect: _Suspect, estimate: PoseEstimate, margin: float) -> _Fit | _Misfit:
    """Ask all rays about a pose."""
    evidence = judge(ordered, suspect.candidate, suspect.rows, estimate, margin)
    against = objections(evidence, ordered.options.least_evidence)
    if against:
        return _Misfit("; ".join(against), PASSED_AT_FIRST + 2 + len(fields(evidence)) - len(against))
    return _Fit(suspect.rows, estimate, evidence)


def _returns_at(ordered: OrderedScan, target: Target, look: OutlineFit) -> Ints:
    """Return the rows (N,) of returns inside an outline, and outside it as far as the target blooms."""
    margin = edge_margin(ordered, target, look.T_lidar_target, _LOOK_SD)
    return returns_of(ordered, target, look.T_lidar_target, margin)


def _likelihoods(scan: Scan, ordered: OrderedScan, fits: Sequence[_Fit]) -> Floats:
    """Return the log likelihood of each fit, from the returns that all fits share."""
    if len(fits) == 1:
        return np.array([fits[0].estimate.log_likelihood])
    ends = [ring_ends(ordered, fit.rows) for fit in fits]
    if all(np.array_equal(one, ends[0]) for one in ends):
        return np.array([fit.estimate.log_likelihood for fit in fits])
    common = fits[0].rows
    for fit in fits[1:]:
        common = np.intersect1d(common, fit.rows)
    returns = scan.select(ordered.index[common])
    again = estimate_poses([returns] * len(fits), [fit.estimate.target for fit in fits], options=ordered.options.pose)
    return np.array([-np.inf if isinstance(one, EstimationError) else one.log_likelihood for one in again])
