"""The pose of a target from its returns in a scan: find it by one of three doors, and conclude; of many at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal, get_args

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError, InputError, expect
from optshape_graph.pose.certificate import NOT_TIGHT, Backend, certify_all
from optshape_graph.pose.containment import find_by_containment
from optshape_graph.pose.evidence import Evidence, Finding, measure
from optshape_graph.pose.fit import Fit, measure_fit
from optshape_graph.pose.options import PoseOptions
from optshape_graph.pose.paper import find_as_paper
from optshape_graph.pose.result import Ambiguity, PoseEstimate, Status
from optshape_graph.pose.rings import find_by_rings
from optshape_graph.scan import Scan, not_in_metres, only_returns, put_right, rings_from_the_top
from optshape_graph.se3 import inverse, inverse_covariance, vec_derivative
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
        scan: the returns on the target and no others, but for points that are none (at the sensor, or beyond any
            reach); its sensor, where known, gives azimuth step, noise and the rings that should have hit.
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
    if isinstance(scans, Scan) or not isinstance(scans, Iterable):
        raise InputError(f"scans: expected a list of Scan, found {type(scans).__name__}; `estimate_pose` takes one")
    if not isinstance(targets, Iterable | Target):
        raise InputError(f"targets: expected a Target or a list of them, found {type(targets).__name__}")
    scans = list(scans)
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
    try:
        return _estimated(scans, templates, method, backend, options)
    except np.linalg.LinAlgError as error:  # of one scan, which the others needn't suffer from
        if len(scans) == 1:
            return [EstimationError(f"{scans[0].name}: no pose can be worked out of these returns ({error})")]
        alone = (
            estimate_poses([scan], [target], method, backend, options)
            for scan, target in zip(scans, templates, strict=True)
        )
        return [estimate for (estimate,) in alone]


def _estimated(
    scans: Sequence[Scan], targets: Sequence[Target], method: Method, backend: Backend, options: PoseOptions
) -> list[PoseEstimate | EstimationError]:
    """Measure, find by the method, and conclude."""
    evidences = _measured(scans, targets, method, options)
    ringed = [one for one in evidences if isinstance(one, Evidence) and one.scan.ring is not None and method != "paper"]
    by_rings = iter(find_by_rings(ringed))
    findings: list[Finding | EstimationError] = []
    for evidence in evidences:
        try:
            if isinstance(evidence, EstimationError):
                findings.append(evidence)
            elif method == "paper":
                findings.append(find_as_paper(evidence, backend))
            else:
                findings.append(find_by_containment(evidence) if evidence.scan.ring is None else next(by_rings))
        except EstimationError as error:
            findings.append(error)
    estimates = iter(conclude([found for found in findings if isinstance(found, Finding)], backend))
    return [found if isinstance(found, EstimationError) else next(estimates) for found in findings]


def _measured(
    scans: Sequence[Scan], targets: Sequence[Target], method: Method, options: PoseOptions
) -> list[Evidence | EstimationError]:
    """Put scans right, and measure what is known of each whatever the pose."""
    found: dict[int, Evidence | EstimationError] = {}
    for k, scan in enumerate(scans):
        if method == "paper" and scan.ring is None:
            found[k] = EstimationError(f"{scan.name}: edge points need rings, and the cloud has none")
        elif objection := not_in_metres(scan.points) or rings_from_the_top(scan):
            found[k] = EstimationError(objection)
        elif scan.ring is not None and len(scan) > 2 and scan.ring.min() == scan.ring.max():
            found[k] = EstimationError(f"{len(scan)} returns on one ring; a pose takes two rings at least")
    good = [k for k in range(len(scans)) if k not in found]
    right = [put_right(only_returns(scans[k])) for k in good]
    measured = measure(right, [targets[k] for k in good], options, as_recorded=method == "paper")
    found.update(zip(good, measured, strict=True))
    return [found[k] for k in range(len(scans))]


def conclude(findings: Sequence[Finding], backend: Backend) -> list[PoseEstimate | EstimationError]:
    """Certify what was found in B scans, judge it, and make the records: the same for every method."""
    if not findings:
        return []
    T_target_lidar = np.array([found.measurement.T_target_lidar for found in findings])
    T_lidar_target = inverse(T_target_lidar)
    J = np.array([found.measurement.L for found in findings]) @ vec_derivative(T_target_lidar)
    information = np.swapaxes(J, 1, 2) @ J + 1e-9 * np.eye(6)
    covariance = inverse_covariance(T_target_lidar, np.linalg.inv(information))
    unobservable = _unobservable(findings, covariance)
    uncertain = _too_uncertain(findings, covariance)
    certificates = certify_all(
        [found.exact for found in findings],
        T_target_lidar,
        [found.total_weight for found in findings],
        backend,
        [found.evidence.problem.options.certified_gap for found in findings],
    )
    estimates: list[PoseEstimate | EstimationError] = []
    for k, (found, fit, certificate) in enumerate(zip(findings, measure_fit(findings), certificates, strict=True)):
        if isinstance(certificate, EstimationError):
            estimates.append(certificate)
            continue
        evidence, problem = found.evidence, found.evidence.problem
        status, reason = _verdict(found, fit, unobservable[k], uncertain[k])
        if status == "ok" and not certificate.certified:
            reason = NOT_TIGHT
        off_plane = evidence.scan.points @ T_target_lidar[k, 0, :3] + T_target_lidar[k, 0, 3]
        estimates.append(
            PoseEstimate(
                target=problem.target,
                T_lidar_target=T_lidar_target[k],
                covariance=covariance[k],
                status=status,
                reason=reason,
                measurement=found.measurement,
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
                unobservable=unobservable[k],
                fit=fit,
                scan=evidence.scan.name,
            )
        )
    return estimates


def _verdict(found: Finding, fit: Fit, unobservable: tuple[str, ...], uncertain: str) -> tuple[Status, str]:
    """Status and reason, the weightiest first."""
    if found.objection:
        return "failed", found.objection
    if unobservable:
        return "failed", "not observable: " + "; ".join(unobservable)
    if fit.flags:
        return "doubtful", fit.reason
    if found.margin < found.evidence.problem.options.ambiguity_margin:
        return "ambiguous", _rivalled(found.margin)
    return ("ambiguous", uncertain) if uncertain else ("ok", "")


def _rivalled(margin: float) -> str:
    """Say that a pose leads by a margin only, or not at all: where samples tell modes apart, all others count."""
    if margin < 0:
        return f"all different poses together are likelier by {-margin:.2g} (log likelihood)"
    return f"a different pose is only {margin:.2g} less likely (log likelihood)"


def _too_uncertain(findings: Sequence[Finding], covariance: Floats) -> list[str]:
    """Say what of a pose is less certain than a pose that can be used may be; empty where nothing is.

    Args:
        findings: of B scans.
        covariance: (B, 6, 6), rotation first.
    """
    said = [""] * len(findings)
    for block, unit, name in ((slice(3, 6), 1.0, "m"), (slice(0, 3), np.degrees(1.0), "deg")):
        values, vectors = np.linalg.eigh(covariance[:, block, block])
        for k, sd in enumerate(np.sqrt(values[:, -1]).tolist()):
            problem, options = findings[k].evidence.problem, findings[k].evidence.problem.options
            turn = name == "deg"
            limit = options.largest_turn_sd if turn else options.largest_shift_sd * problem.target.circumradius
            if sd > limit:
                direction = _DIRECTIONS[block][int(np.abs(vectors[k, :, -1]).argmax())]
                n = len(findings[k].evidence.scan)
                seen = f"{problem.edges.n_rings} rings" if len(problem.edges) else f"{n} returns"
                found_sd, largest = f"{sd * unit:.2g} {name}", f"{limit * unit:.2g}"
                said[k] = (
                    f"too uncertain: {direction} has a standard deviation of {found_sd}, over {largest}, from {seen}"
                )
    return said


def _unobservable(findings: Sequence[Finding], covariance: Floats) -> list[tuple[str, ...]]:
    """Name what poses' covariances leave undetermined, the target's radius counting as one radian.

    Args:
        findings: of B scans.
        covariance: (B, 6, 6), rotation first.
    """
    scale = np.ones((len(findings), 6))
    scale[:, 3:] = np.array([[found.evidence.problem.target.circumradius] for found in findings])
    values, vectors = np.linalg.eigh(covariance / (scale[:, :, None] * scale[:, None, :]))
    names: list[tuple[str, ...]] = []
    for found, of_values, of_vectors in zip(findings, values, vectors, strict=True):
        open_ = np.flatnonzero(of_values > found.evidence.problem.options.unobservable_sd**2)
        names.append(tuple(_in_words(of_vectors[:, k]) for k in open_))
    return names


def _in_words(direction: Floats) -> str:
    """Name the largest parts of a direction (6,), rotation first."""
    return " with ".join(_DIRECTIONS[k] for k in np.argsort(-np.abs(direction)) if abs(direction[k]) > 0.4)
