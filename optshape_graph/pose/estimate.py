"""The pose of a target from its returns in a scan: find it by one of three doors, and conclude; of many at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError, InputError, expect
from optshape_graph.pose.certificate import NOT_TIGHT, Backend, certify
from optshape_graph.pose.containment import find_by_containment
from optshape_graph.pose.evidence import Evidence, Finding, measure
from optshape_graph.pose.fit import Fit, measure_fit
from optshape_graph.pose.options import PoseOptions
from optshape_graph.pose.paper import find_as_paper
from optshape_graph.pose.result import Ambiguity, PoseEstimate, Status
from optshape_graph.pose.rings import find_by_rings
from optshape_graph.scan import Scan, not_in_metres, put_right, without_duplicates
from optshape_graph.se3 import inverse, inverse_covariance
from optshape_graph.target import Target

Method = Literal["global", "paper"]

_DIRECTIONS = ("rotation about x", "rotation about y", "rotation about z",
               "translation along x", "translation along y", "translation along z")  # fmt: skip


def estimate_pose(
    scan: Scan,
    target: Target,
    method: Method = "global",
    backend: Backend = "closed-form",
    options: PoseOptions = PoseOptions(),
) -> PoseEstimate:
    """Estimate the pose of a target from its returns.

    Args:
        scan: the returns on the target and no others; its sensor, where known, gives azimuth step, noise and the
            rings that should have hit.
        target: the template.
        method: "global" enumerates every consistent association of edge points to edges, finds the posterior of the
            pose under the best of them, and certifies it; of a cloud without rings it finds the posterior over all
            poses that contain the returns. "paper" is the alternation of Huang, Clark and Grizzle, for comparison.
        backend: what finds the certificate's multipliers: "closed-form", with "clarabel" where that does not do;
            "clarabel", which solves the relaxation; "cvxpy", the modelling layer above it.
        options: assumptions and thresholds.

    Returns:
        The estimate. Its status says whether it can be used.

    Raises:
        InputError: a method or a backend that does not exist, or something else than a scan, a target and options.
        EstimationError: the returns determine no pose at all: none, fewer than three, all on a line, not in metres,
            no azimuth step to be found.
    """
    expect("scan", scan, Scan)
    expect("target", target, Target)
    (estimate,) = estimate_poses([scan], target, method, backend, options)
    if isinstance(estimate, EstimationError):
        raise estimate
    return estimate


def estimate_poses(
    scans: Sequence[Scan],
    targets: Target | Sequence[Target],
    method: Method = "global",
    backend: Backend = "closed-form",
    options: PoseOptions = PoseOptions(),
) -> list[PoseEstimate | EstimationError]:
    """Estimate the pose of a target in each of B scans, faster than one by one.

    What is said of a scan does not depend on the others, but for rounding.

    Args:
        scans: (B,) the returns on one target each, as for `estimate_pose`. They may be of different sensors.
        targets: the template, or that of each scan (B,).
        method: as for `estimate_pose`.
        backend: as for `estimate_pose`.
        options: assumptions and thresholds.

    Returns:
        For each scan the estimate; or the error, where the returns determine no pose at all.

    Raises:
        InputError: a method or a backend that does not exist, something else than scans, targets and options, or
            another number of targets than of scans.
    """
    templates = [targets] * len(scans) if isinstance(targets, Target) else list(targets)
    if len(templates) != len(scans):
        raise InputError(f"{len(templates)} targets for {len(scans)} scans; expected one for all, or one for each")
    for scan, target in zip(scans, templates, strict=True):
        expect("scan", scan, Scan)
        expect("target", target, Target)
    expect("options", options, PoseOptions)
    for name, value, choices in (("method", method, get_args(Method)), ("backend", backend, get_args(Backend))):
        if value not in choices:
            raise InputError(f"{name} is {value!r}; expected one of {', '.join(map(repr, choices))}")
    evidences = [_measured(*pair, method, options) for pair in zip(scans, templates, strict=True)]
    ringed = [one for one in evidences if isinstance(one, Evidence) and one.scan.ring is not None and method != "paper"]
    by_rings = iter(find_by_rings(ringed))
    estimates: list[PoseEstimate | EstimationError] = []
    for evidence in evidences:
        if isinstance(evidence, EstimationError):
            estimates.append(evidence)
            continue
        try:
            if method == "paper":
                found: Finding | EstimationError = find_as_paper(evidence, backend)
            else:
                found = find_by_containment(evidence) if evidence.scan.ring is None else next(by_rings)
            estimates.append(found if isinstance(found, EstimationError) else conclude(found, backend))
        except EstimationError as error:
            estimates.append(error)
    return estimates


def _measured(scan: Scan, target: Target, method: Method, options: PoseOptions) -> Evidence | EstimationError:
    """Put a scan right, and measure what is known of it whatever the pose."""
    if method == "paper" and scan.ring is None:
        return EstimationError(f"{scan.name}: edge points need rings, and the cloud has none")
    if objection := not_in_metres(scan.points):
        return EstimationError(objection)
    try:
        whole, duplicates = without_duplicates(put_right(scan))
        return measure(whole, target, options, duplicates, as_recorded=method == "paper")
    except EstimationError as error:
        return error


def conclude(found: Finding, backend: Backend) -> PoseEstimate:
    """Certify what was found, judge it, and make the record: the same for every method."""
    evidence, measurement = found.evidence, found.measurement
    problem, options = evidence.problem, evidence.problem.options
    T_target_lidar = measurement.T_target_lidar
    T_lidar_target = inverse(T_target_lidar)
    information = measurement.information() + 1e-9 * np.eye(6)
    covariance = inverse_covariance(T_target_lidar, np.linalg.inv(information))
    unobservable = unobservable_directions(covariance, problem.target.circumradius, options.unobservable_sd)
    fit = measure_fit(found)
    status, reason = _verdict(found, fit, covariance, unobservable)
    certificate = certify(found.exact, T_target_lidar, found.total_weight, backend, options.certified_gap)
    if status == "ok" and not certificate.certified:
        reason = NOT_TIGHT
    off_plane = evidence.scan.points @ T_target_lidar[0, :3] + T_target_lidar[0, 3]
    return PoseEstimate(
        target=problem.target,
        T_lidar_target=T_lidar_target,
        covariance=covariance,
        status=status,
        reason=reason,
        measurement=measurement,
        shared=found.shared,
        certificate=certificate,
        ambiguity=Ambiguity(found.margin, found.rival),
        log_likelihood=found.log_likelihood,
        edge_points=problem.edges,
        labels=found.labels,
        inset=found.inset,
        edge_sigma=found.edge_sigma,
        edge_residuals=found.edge_residuals,
        plane_rms=float(np.sqrt(np.mean(off_plane**2))),
        n_returns=len(evidence.scan),
        unobservable=unobservable,
        fit=fit,
        scan=evidence.scan.name,
    )


def _verdict(found: Finding, fit: Fit, covariance: Floats, unobservable: tuple[str, ...]) -> tuple[Status, str]:
    """Status and reason, the weightiest first."""
    if found.objection:
        return "failed", found.objection
    if unobservable:
        return "failed", "not observable: " + "; ".join(unobservable)
    if fit.flags:
        return "doubtful", fit.reason
    if found.margin < found.evidence.problem.options.ambiguity_margin:
        return "ambiguous", f"a different pose is only {found.margin:.2g} less likely (log likelihood)"
    uncertain = _too_uncertain(found.evidence, covariance)
    return ("ambiguous", uncertain) if uncertain else ("ok", "")


def _too_uncertain(evidence: Evidence, covariance: Floats) -> str:
    """Say what of a pose is less certain than a pose that can be used may be; empty where nothing is."""
    problem, options = evidence.problem, evidence.problem.options
    size = problem.target.circumradius
    seen = f"{problem.edges.n_rings} rings" if len(problem.edges) else f"{len(evidence.scan)} returns"
    for block, limit, unit, name in (
        (slice(0, 3), options.largest_turn_sd, np.degrees(1.0), "deg"),
        (slice(3, 6), options.largest_shift_sd * size, 1.0, "m"),
    ):
        values, vectors = np.linalg.eigh(covariance[block, block])
        sd = float(np.sqrt(values[-1]))
        if sd > limit:
            direction = _DIRECTIONS[block][int(np.abs(vectors[:, -1]).argmax())]
            found_sd, largest = f"{sd * unit:.2g} {name}", f"{limit * unit:.2g}"
            return f"too uncertain: {direction} has a standard deviation of {found_sd}, over {largest}, from {seen}"
    return ""


def unobservable_directions(covariance: Floats, size: float, largest_sd: float) -> tuple[str, ...]:
    """Name what a pose's covariance leaves undetermined.

    Args:
        covariance: (6, 6), rotation first.
        size: metres that count as one radian: the target's radius.
        largest_sd: standard deviation, rad or sizes, beyond which a direction is undetermined.
    """
    scale = np.array([1.0, 1.0, 1.0, size, size, size])
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    names = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value > largest_sd**2:
            parts = [_DIRECTIONS[k] for k in np.argsort(-np.abs(vector)) if abs(vector[k]) > 0.4]
            names.append(" with ".join(parts))
    return tuple(names)
