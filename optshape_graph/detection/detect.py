"""Targets in a full scan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optshape_graph.detection.candidates import Candidate, grow
from optshape_graph.detection.identify import identify, rejection
from optshape_graph.detection.judge import MIN_STEPPED, not_stepped
from optshape_graph.detection.patches import find_patches
from optshape_graph.detection.results import Detection, Detections, Rejection
from optshape_graph.detection.segments import Sweep, sweep
from optshape_graph.detection.size import Size
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.scan import Scan
from optshape_graph.target import Target

MIN_RINGS = 4
"""Rings on a target at least: the ends of three say no more than the size and place of anything."""


def detect_targets(scan: Scan, targets: Target | Sequence[Target]) -> Detections:
    """Find targets in a full scan, and tell them apart by shape.

    Rings are cut where the range jumps (`segments`); segments in one plane make patches (`patches`), which grow to
    all returns in their plane (`candidates`). What covers about the area of a target, spread as a target's, is given to
    the pose estimator; each pose is judged by every ray near it (`judge`); the targets that pass compete by likelihood.

    Args:
        scan: a full revolution, with rings; its sensor, where known, gives azimuth step, noise and the rings there are.
        targets: those to look for, one or several. Any number of each may be in the scan.

    Raises:
        InputError: no targets, two of one name, or a scan without rings.
    """
    targets = [targets] if isinstance(targets, Target) else list(targets)
    if not targets:
        raise InputError("no targets to look for")
    names = [target.name for target in targets]
    if len(set(names)) < len(names):
        raise InputError(f"targets to tell apart need different names; found {', '.join(names)}")
    try:
        ordered = sweep(scan)
    except EstimationError:
        return Detections((), (), scan.name)
    sizes = [Size.of(target) for target in targets]
    found: list[Detection] = []
    rejected: list[Rejection] = []
    taken = np.zeros(len(ordered), dtype=bool)
    for candidate in _candidates(ordered, sizes, rejected):
        if taken[candidate.rows].mean() > 0.5:
            continue
        detection, others = identify(scan, ordered, candidate, targets, sizes)
        rejected += others
        if detection is not None:
            taken[candidate.rows] = True
            found.append(detection)
    return Detections(tuple(sorted(found, key=lambda one: -one.score)), tuple(rejected), scan.name)


def _candidates(ordered: Sweep, sizes: Sequence[Size], rejected: list[Rejection]) -> list[Candidate]:
    """Surfaces of about the size of a target, the largest first."""
    least, most = min(size.area for size in sizes), max(size.area for size in sizes)
    width, diameter = min(size.width for size in sizes), max(size.diameter for size in sizes)
    candidates = []
    for patch in find_patches(ordered, shortest=0.2 * width, longest=1.1 * diameter):
        # Tips and rings that run on into something else are not in the patch yet, so its area says little.
        if patch.n_rings < MIN_RINGS - 1 or not 0.25 * least < patch.area < 1.5 * most:
            continue
        try:
            candidate = grow(ordered, patch, 1.5 * diameter)
        except EstimationError:
            continue
        problem = _problem(candidate, sizes)
        if problem:
            rejected.append(rejection(candidate, problem))
        else:
            candidates.append(candidate)
    return sorted(candidates, key=lambda one: -len(one.rows))


def _problem(candidate: Candidate, sizes: Sequence[Size]) -> str:
    """Why a candidate can be none of the targets; empty: it can be one."""
    objections = [size.objection(candidate) for size in sizes]
    if all(objections):
        return objections[0]
    if candidate.n_rings < MIN_RINGS:
        return f"{candidate.n_rings} rings on it; at least {MIN_RINGS} are needed"
    if candidate.stepped < MIN_STEPPED:
        return not_stepped(candidate.stepped)
    return ""
