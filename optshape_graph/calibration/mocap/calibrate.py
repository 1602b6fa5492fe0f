"""Calibration of a LiDAR to motion capture: scans and markers of a session in one graph, and judged by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.mocap.agreement import Agreement, find_agreement, other_frame, without_fallen_marker
from optshape_graph.calibration.mocap.comparison import MIN_MARKERS, MocapScan, in_sample, leave_one_out
from optshape_graph.calibration.mocap.graph import Innovation, MarkerModel, innovations, solve
from optshape_graph.calibration.mocap.judgement import FEWEST, contradicting, judge
from optshape_graph.calibration.mocap.layout import CheckedMarkers, marker_out_of_place
from optshape_graph.calibration.mocap.result import LeftOut, MocapCalibration
from optshape_graph.calibration.mocap.session import load_mocap_scans
from optshape_graph.calibration.verdict import Finding
from optshape_graph.errors import EstimationError, InputError, expect
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.sessions import Session, load_session
from optshape_graph.pose import refine
from optshape_graph.runs.kept import Kept
from optshape_graph.se3 import angle, inverse

SCALE_OFF = (0.01, 4.0)
"""Scale by which the motion capture is off at least, and in standard deviations, to be called so."""


def calibrate_mocap(
    session: str | Path | Session,
    *,
    estimate_scale: bool = False,
    marker_noise: float = MarkerModel.noise,
    layout_prior: float = MarkerModel.layout_prior,
    progress: Callable[[int, int], None] = lambda done, total: None,
    kept: Kept | None = None,
) -> MocapCalibration:
    """Calibrate T_lidar_mocap and the marker layout of a session, and say how far to trust them.

    Markers out of place, mixed-up names and scans that contradict the others are put right or left out, and named in
    the result's `warnings`.

    Args:
        session: its file, or what `load_session` returned: one LiDAR, one target, motion capture.
        estimate_scale: estimate the motion capture's scale as well; else it is 1.
        marker_noise: standard deviation of a marker coordinate, metres.
        layout_prior: standard deviation of a marker's place about its vertex along each axis, metres.
        progress: called with the number of scans estimated, and their total.
        kept: estimates of a run that was stopped, and of this one (`runs.kept.keeping`); None: they are not kept.

    Raises:
        InputError: a session that can't be read or used, or markers in another unit of length.
        EstimationError: fewer than two scans can be used; or the scans contradict each other so that no calibration
            can be given, and the message says what seems to be wrong.
    """
    expect("session", session, str, Path, Session)
    loaded = session if isinstance(session, Session) else load_session(session)
    passed_over = PassedOver()
    scans, left_out, checked = load_mocap_scans(loaded, layout_prior, progress, passed_over, kept)
    if len(scans) < 2:
        reasons = "".join(f"; {item.scan}: {item.reason}" for item in left_out)
        raise EstimationError(
            f"{loaded.path}: a motion-capture calibration needs at least two scans, found {len(scans)}{reasons}"
        )
    findings = list(checked.findings)
    if checked.doubted:
        scans, findings = _without_fallen(scans, checked)
    model = MarkerModel(marker_noise, layout_prior, estimate_scale)
    result = calibrate_scans(scans, model, left_out, findings, str(loaded.path))
    return replace(result, passed_over=passed_over)


def calibrate_scans(
    scans: Sequence[MocapScan],
    model: MarkerModel | None = None,
    left_out: Sequence[LeftOut] = (),
    findings: Sequence[Finding] = (),
    where: str = "the session",
) -> MocapCalibration:
    """Calibrate scans that are estimated already.

    Args:
        scans: two at least, all of one target, in one LiDAR and one motion-capture frame.
        model: of the markers.
        left_out: scans that took no part, to be listed in the result.
        findings: about the markers, to be judged with the rest.
        where: the session's file, for messages.

    Raises:
        InputError: fewer than two scans, scans of different targets, or a scan with fewer than three markers.
        EstimationError: see `calibrate_mocap`.
    """
    if len(scans) < 2:
        raise InputError(f"a motion-capture calibration needs at least two scans, found {len(scans)}")
    target = scans[0].estimate.target
    if any(not np.array_equal(scan.estimate.target.vertices, target.vertices) for scan in scans):
        raise InputError("a motion-capture calibration is of one target; the scans have several")
    model = model or MarkerModel()
    try:
        agreement = find_agreement(scans, where)
    except EstimationError as error:
        known = "".join(f"; {finding.text}" for finding in findings)
        raise EstimationError(f"{error}{known}") from error
    voted = [int(i) for i in np.flatnonzero(agreement.agreeing)]
    of_scale = _of_scale(agreement, model, voted)
    if of_scale:
        model = replace(model, with_scale=True)
    used, compared = _robustly(agreement, model, voted)
    solution = solve(agreement.scans, agreement.T_lidar_mocap, model, used)
    chosen = tuple(agreement.scans[i] for i in used)
    rejected = tuple(
        LeftOut(scan.name, _why(scan, agreement.scans, solution.T_lidar_mocap, compared[i].T_lidar_target))
        for i, scan in enumerate(agreement.scans) if i not in used
    )  # fmt: skip
    scatter = _scatter(chosen, [solution.T_target_lidar[i] for i in used])
    widening = max(1.0, scatter)
    return MocapCalibration(
        T_lidar_mocap=solution.T_lidar_mocap,
        covariance=solution.covariance * widening,
        marker_layout=solution.layout,
        layout_sigma=np.sqrt(np.diagonal(solution.layout_covariance, axis1=1, axis2=2) * widening),
        scale=solution.scale,
        scale_sigma=float(solution.scale_sigma * np.sqrt(widening)),
        T_lidar_target=tuple(inverse(solution.T_target_lidar[i]) for i in used),
        scatter=scatter,
        chi_square=tuple(compared[i].chi_square for i in used),
        leave_one_out=leave_one_out(chosen),
        in_sample=in_sample(chosen),
        scans=chosen,
        left_out=(*left_out, *rejected),
        findings=(*findings, *of_scale, *judge(chosen, solution, model, scatter, compared, used)),
    )


def _without_fallen(scans: Sequence[MocapScan], checked: CheckedMarkers) -> tuple[tuple[MocapScan, ...], list[Finding]]:
    """Leave out the marker that is not at its vertex, if the scans can do without it."""
    rest, k = without_fallen_marker(scans, checked.doubted)
    if any(np.isfinite(scan.markers).all(axis=1).sum() < MIN_MARKERS for scan in rest):
        return tuple(scans), list(checked.findings)
    off = marker_out_of_place(scans[0].estimate.target, [scan.markers for scan in scans], k)
    text = (
        f"the marker of vertex {k} is {off:.3f} m from it in all frames, by the other markers: did it fall? It was "
        f"left out"
    )
    return rest, [*checked.findings, Finding(text, True)]


def _of_scale(agreement: Agreement, model: MarkerModel, used: Sequence[int]) -> list[Finding]:
    """Say if the motion capture's scale is off, by how far the target moved from scan to scan."""
    solution = solve(agreement.scans, agreement.T_lidar_mocap, replace(model, with_scale=True), used)
    scatter = _scatter([agreement.scans[i] for i in used], [solution.T_target_lidar[i] for i in used])
    least, sigmas = SCALE_OFF
    sigma = solution.scale_sigma * np.sqrt(max(1.0, scatter))
    if model.with_scale or abs(solution.scale - 1) < max(least, sigmas * sigma):
        return []
    size = "small" if solution.scale > 1 else "large"
    text = (
        f"the motion capture's lengths are {100 * abs(1 / solution.scale - 1):.1f} % too {size} (sd "
        f"{100 * sigma:.1f} %) for how far the target moved between the scans: calibrate it again, or is the unit "
        f"another? The scale was estimated, and the result holds for it"
    )
    return [Finding(text, True)]


def _robustly(
    agreement: Agreement, model: MarkerModel, voted: Sequence[int]
) -> tuple[list[int], dict[int, Innovation]]:
    """Leave out the worst scan or take in those that turn out to agree, until nothing changes.

    Returns:
        The numbers of the scans used, and how every scan compares with them.
    """
    used, tried = set(voted), list[set[int]]()
    while True:
        compared = innovations(agreement.scans, agreement.T_lidar_mocap, model, sorted(used))
        bad = contradicting(compared, used, model)
        tried.append(used)
        worst = next((i for i in bad if i in used), None)
        used = used | (set(compared) - set(bad)) if worst is None or len(used) <= FEWEST else used - {worst}
        if used in tried:
            return sorted(tried[-1]), compared


def _why(scan: MocapScan, scans: Sequence[MocapScan], T_lidar_mocap: Floats, predicted: Floats) -> str:
    """Say how far a scan is from where the others put it, and whose markers it fits instead."""
    T = scan.estimate.T_lidar_target
    turn = np.degrees(angle(predicted[:3, :3].T @ T[:3, :3]))
    return (
        f"scan and markers (frame {scan.frame}) disagree by {np.linalg.norm(T[:3, 3] - predicted[:3, 3]):.3f} m and "
        f"{turn:.1f} deg with T_lidar_mocap of the other scans{other_frame(scan, scans, T_lidar_mocap)}"
    )


def _scatter(scans: Sequence[MocapScan], T_target_lidar: Sequence[Floats]) -> float:
    """Mean square disagreement of the scans with the joint poses, in their own standard deviations.

    The rise of each measurement's cost above its minimum is chi-square with 6 degrees of freedom, less what the
    common transform and the layout were fitted with.
    """
    rise = sum(
        2 * (scan.estimate.measurement.error(T) - scan.estimate.measurement.error(refine(scan.estimate.measurement)))
        for scan, T in zip(scans, T_target_lidar, strict=True)
    )
    return float(rise / max(6 * len(scans) - 12, 1))
