"""Tell which target a surface is: fit each of the right size, drop what does not fit, take the likeliest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.detection.candidates import Candidate, Size
from optshape_graph.detection.judge import edge_margin, judge, objections, returns_of, undoubted
from optshape_graph.detection.results import Detection, Evidence, Rejection
from optshape_graph.detection.segments import OrderedScan, ring_ends
from optshape_graph.errors import EstimationError
from optshape_graph.pose import PoseEstimate, estimate_pose
from optshape_graph.scan import Scan
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class _Fit(Value):
    """One target fitted to a candidate: rows of the ordered scan taken for its returns, pose, evidence."""

    rows: Ints
    estimate: PoseEstimate
    evidence: Evidence


@dataclass(frozen=True)
class _Misfit:
    """Why a candidate is not a target, and how many tests it passed before."""

    reason: str
    passed: int


PASSED_AT_FIRST = 3
"""Tests before a pose is estimated: of size, number of rings, and how they end."""


def identify(
    scan: Scan, ordered: OrderedScan, candidate: Candidate, targets: Sequence[Target], sizes: Sequence[Size]
) -> tuple[Detection | None, list[Rejection]]:
    """Find the target that a candidate is.

    Args:
        scan: what it was found in.
        ordered: the same, ordered.
        candidate: a surface.
        targets: those it may be.
        sizes: of each.

    Returns:
        The detection, if any, and why it is none of the other targets.
    """
    fits: list[_Fit] = []
    rejected: list[Rejection] = []
    for target, size in zip(targets, sizes, strict=True):
        fit = _compare(scan, ordered, candidate, target, size)
        if isinstance(fit, _Misfit):
            rejected.append(rejection(candidate, fit.reason, fit.passed, target.name))
        else:
            fits.append(fit)
    if not fits:
        return None, rejected
    likelihoods = _likelihoods(scan, ordered, fits)
    order = np.argsort(-likelihoods, kind="stable")
    best = fits[order[0]]
    rival = fits[order[1]].estimate.target if len(fits) > 1 else None
    margin = float(likelihoods[order[0]] - likelihoods[order[1]]) if len(fits) > 1 else np.inf
    status, reason = best.estimate.status, best.estimate.reason
    share = np.exp(likelihoods[order] - np.logaddexp.reduce(likelihoods))
    probabilities = {fits[k].estimate.target.name: float(p) for k, p in zip(order, share, strict=True)}
    evidence, options = best.evidence, ordered.options
    if status == "ok" and evidence.seen < options.certain_seen:
        status, reason = "ambiguous", f"only {evidence.seen:.0%} of its outline is within the field of view"
    elif status == "ok" and evidence.distinct < options.certain_distinct:
        n_rings = len(np.unique(ordered.ring[best.rows]))
        status, reason = "ambiguous", f"the ends of its {n_rings} rings would fit surfaces of other shapes too"
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
    """Say why a candidate is not a target, or none of them."""
    return Rejection(
        reason=reason,
        passed=passed,
        target=target,
        centre=candidate.plane.centre,
        n_returns=len(candidate.rows),
        n_rings=candidate.n_rings,
        area=candidate.area,
    )


def _compare(scan: Scan, ordered: OrderedScan, candidate: Candidate, target: Target, size: Size) -> _Fit | _Misfit:
    """Fit a target to a candidate, or say why it is not that target."""
    problem = size.objection(candidate, ordered.options)
    if problem:
        return _Misfit(problem, 0)
    fit = _fit(scan, ordered, candidate, candidate.rows, target)
    if isinstance(fit, _Misfit) and len(candidate.core) < len(candidate.rows):
        # A bit of a stand can pass for the tip of a target. Without it the pose may be found, and then the true tips.
        again = _fit(scan, ordered, candidate, candidate.core, target)
        return fit if isinstance(again, _Misfit) else again
    return fit


def _fit(scan: Scan, ordered: OrderedScan, candidate: Candidate, rows: Ints, target: Target) -> _Fit | _Misfit:
    """Estimate the pose, and choose the returns again by its outline, until the ends of the rings stay the same."""
    for _ in range(ordered.options.rounds):
        try:
            estimate = estimate_pose(scan.select(ordered.index[rows]), target, options=ordered.options.pose)
        except EstimationError as error:
            return _Misfit(str(error), PASSED_AT_FIRST)
        margin = edge_margin(ordered, estimate)
        inside = returns_of(ordered, estimate, margin)
        if len(inside) == 0:
            return _Misfit("none of its returns lies inside the outline at the pose they give", PASSED_AT_FIRST)
        if np.array_equal(ring_ends(ordered, inside), ring_ends(ordered, rows)):
            break
        rows = inside
    # A pose that is not determined is no objection to the target being there.
    if estimate.status == "failed" and not estimate.unobservable:
        return _Misfit(estimate.reason, PASSED_AT_FIRST)
    evidence = judge(ordered, candidate.rows, inside, estimate, margin)
    against = objections(evidence, ordered.options.least_evidence)
    if against:
        return _Misfit("; ".join(against), PASSED_AT_FIRST + 1 + len(fields(evidence)) - len(against))
    return _Fit(inside, estimate, evidence)


def _likelihoods(scan: Scan, ordered: OrderedScan, fits: Sequence[_Fit]) -> Floats:
    """Return the log likelihood of each fit, from the same returns: those that all of them take for theirs."""
    if len(fits) == 1:
        return np.array([fits[0].estimate.log_likelihood])
    ends = [ring_ends(ordered, fit.rows) for fit in fits]
    if all(np.array_equal(one, ends[0]) for one in ends):
        return np.array([fit.estimate.log_likelihood for fit in fits])
    common = fits[0].rows
    for fit in fits[1:]:
        common = np.intersect1d(common, fit.rows)
    returns = scan.select(ordered.index[common])
    return np.array(
        [estimate_pose(returns, fit.estimate.target, options=ordered.options.pose).log_likelihood for fit in fits]
    )
