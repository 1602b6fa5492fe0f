"""Targets in a full scan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optshape_graph.detection.candidates import Candidate, Size, grow
from optshape_graph.detection.identify import PASSED_AT_FIRST, fit_targets, identify, rejection
from optshape_graph.detection.judge import not_stepped
from optshape_graph.detection.options import DetectionOptions
from optshape_graph.detection.patches import find_patches
from optshape_graph.detection.results import Detection, Detections, Rejection
from optshape_graph.detection.segments import OrderedScan, order_scan
from optshape_graph.errors import EstimationError, InputError, expect
from optshape_graph.scan import Scan, not_in_metres, put_right, rings_from_the_top
from optshape_graph.target import Target

_DEFAULTS = DetectionOptions()


def detect_targets(scan: Scan, targets: Target | Sequence[Target], options: DetectionOptions = _DEFAULTS) -> Detections:
    """Find targets in a full scan, and tell them apart by shape.

    Rings are cut where the range jumps (`segments`). Segments in one plane make patches (`patches`), which grow to
    all returns in their plane (`candidates`). Surfaces of about a target's area and spread are given to the pose
    estimator, all at once, and each pose is judged by every ray near it (`judge`). The targets that pass compete by
    likelihood (`identify`).

    Args:
        scan: a full revolution, with rings. Its sensor, if known, gives azimuth step, noise and the table of rings.
        targets: one target or several to look for. Any number of each may be in the scan.
        options: the settings.

    Raises:
        InputError: no targets, other objects than targets, two targets of one name, or a scan without rings, with
            rings that are counted from the top, or in millimetres.
    """
    expect("scan", scan, Scan)
    expect("options", options, DetectionOptions)
    if objection := not_in_metres(scan.points) or rings_from_the_top(scan):
        raise InputError(f"{scan.name}: {objection}")
    wanted, scan = _wanted(targets), put_right(scan)
    try:
        ordered = order_scan(scan, options)
    except EstimationError:
        return Detections((), (), scan.name)
    sizes = [Size.of(target) for target in wanted]
    found: list[Detection] = []
    rejected: list[Rejection] = []
    taken = np.zeros(len(ordered), dtype=bool)
    candidates = _candidates(ordered, sizes, rejected)
    for candidate, fitted in zip(candidates, fit_targets(scan, ordered, candidates, wanted, sizes), strict=True):
        if taken[candidate.rows].mean() > 0.5:
            continue
        detection, others = identify(scan, ordered, candidate, fitted)
        rejected += others
        if detection is not None:
            taken[candidate.rows] = True
            found.append(detection)
    rejected.sort(key=lambda one: (-one.passed, -one.n_returns))
    return Detections(tuple(sorted(found, key=lambda one: -one.score)), tuple(rejected), scan.name)


def _wanted(targets: Target | Sequence[Target]) -> tuple[Target, ...]:
    """Return the targets to look for, after checks."""
    if isinstance(targets, Target):
        return (targets,)
    if isinstance(targets, str) or not isinstance(targets, Sequence):
        raise InputError(f"targets: expected a Target or a list of them, found {type(targets).__name__}")
    for target in targets:
        if not isinstance(target, Target):
            raise InputError(f"targets: expected a Target or a list of them, found {type(target).__name__} in the list")
    if not targets:
        raise InputError("no targets to look for")
    names = [target.name for target in targets]
    if len(set(names)) < len(names):
        raise InputError(f"targets to tell apart need different names; found {', '.join(names)}")
    return tuple(targets)


def _candidates(ordered: OrderedScan, sizes: Sequence[Size], rejected: list[Rejection]) -> list[Candidate]:
    """Find surfaces of about the size of a target, the largest first."""
    least, most = min(size.area for size in sizes), max(size.area for size in sizes)
    width, diameter = min(size.width for size in sizes), max(size.diameter for size in sizes)
    candidates = []
    for patch in find_patches(ordered, shortest=0.2 * width, longest=1.1 * diameter):
        # Tips, and rings that run on into something else, are not in the patch yet, so its area tells little.
        if patch.n_rings < ordered.options.fewest_rings - 1 or not 0.25 * least < patch.area < 1.5 * most:
            continue
        try:
            candidate = grow(ordered, patch, 1.5 * diameter)
        except EstimationError:
            continue
        problem, passed = _problem(candidate, sizes, ordered.options)
        if problem:
            rejected.append(rejection(candidate, problem, passed))
        else:
            candidates.append(candidate)
    return sorted(candidates, key=lambda one: -len(one.rows))


def _problem(candidate: Candidate, sizes: Sequence[Size], options: DetectionOptions) -> tuple[str, int]:
    """Return why a candidate cannot be any of the targets, and how many tests it passed; empty: it can be one."""
    objections = [size.objection(candidate, options) for size in sizes]
    if all(objections):
        return objections[0], 0
    if candidate.n_rings < options.fewest_rings:
        return f"{candidate.n_rings} rings on it; at least {options.fewest_rings} are needed", 1
    if candidate.stepped < options.least_evidence.stepped:
        return not_stepped(candidate.stepped), 2
    return "", PASSED_AT_FIRST
