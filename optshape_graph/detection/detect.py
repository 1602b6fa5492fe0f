"""Targets in a full scan."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np

from optshape_graph.detection.candidates import Candidate, Size, grow
from optshape_graph.detection.identify import PASSED_AT_FIRST, Surface, TargetFits, fit_targets, identify, rejection
from optshape_graph.detection.judge import not_stepped
from optshape_graph.detection.options import DetectionOptions
from optshape_graph.detection.patches import find_patches
from optshape_graph.detection.results import Detection, Detections, Rejection
from optshape_graph.detection.segments import Fired, OrderedScan, order_scan
from optshape_graph.errors import EstimationError, InputError, expect
from optshape_graph.scan import Scan, not_in_metres, put_right, rings_from_the_top, rings_missing
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
    (found,) = detect_in_scans([Search(scan, targets)], options)
    if isinstance(found, InputError):
        raise found
    return found


class Search(NamedTuple):
    """A full scan, and what to look for in it.

    Attributes:
        scan: a full revolution, as for `detect_targets`.
        targets: one target or several.
        fired: of a scan that was taken while moving, and set right: given rows (K,) of returns on one target, returns
            them as they were fired, so that rings are where they should be, and the frame T_scan_frame (4, 4) that
            they are in. Poses are estimated from those, and each `Detection.estimate` is in its own frame. None: the
            scan is as it was fired.
    """

    scan: Scan
    targets: Target | Sequence[Target]
    fired: Fired | None = None


def detect_in_scans(searches: Sequence[Search], options: DetectionOptions = _DEFAULTS) -> list[Detections | InputError]:
    """Find targets in each of several full scans, faster than one by one: the surfaces of all are looked at together.

    What is found in a scan does not depend on the others, but for rounding. Memory grows with their number.

    Args:
        searches: the scans, of any sensors, and their targets.
        options: the settings.

    Returns:
        For each scan what was found; or the error, where `detect_targets` would raise it.

    Raises:
        InputError: something else than options.
    """
    expect("options", options, DetectionOptions)
    rejected: list[list[Rejection]] = [[] for _ in searches]
    searched: list[list[Surface] | InputError] = []
    for search, against in zip(searches, rejected, strict=True):
        try:
            searched.append(_surfaces(search, options, against))
        except InputError as error:
            searched.append(error)
    fits = iter(fit_targets([one for of_scan in searched if not isinstance(of_scan, InputError) for one in of_scan]))
    return [
        surfaces
        if isinstance(surfaces, InputError)
        else _identified(search.scan, surfaces, list(islice(fits, len(surfaces))), against)
        for search, surfaces, against in zip(searches, searched, rejected, strict=True)
    ]


def unsearchable(scan: Scan) -> InputError | None:
    """Return the error that `detect_targets` raises for a scan, whatever the targets; None: it can be searched.

    Args:
        scan: a full revolution.
    """
    if objection := not_in_metres(scan.points) or rings_from_the_top(scan):
        return InputError(f"{scan.name}: {objection}")
    return rings_missing(scan) if scan.ring is None else None


def _surfaces(search: Search, options: DetectionOptions, rejected: list[Rejection]) -> list[Surface]:
    """Find the surfaces in a scan that may be targets, the largest first.

    Raises:
        InputError: as `detect_targets`.
    """
    expect("scan", search.scan, Scan)
    targets = _wanted(search.targets)
    if (error := unsearchable(search.scan)) is not None:
        raise error
    try:
        ordered = order_scan(put_right(search.scan), options, search.fired)
    except EstimationError:
        return []
    sizes = tuple(Size.of(target) for target in targets)
    return [Surface(ordered, candidate, targets, sizes) for candidate in _candidates(ordered, sizes, rejected)]


def _identified(
    scan: Scan, surfaces: Sequence[Surface], fits: Sequence[TargetFits], rejected: list[Rejection]
) -> Detections:
    """Take each return of a scan for one target at most, that of the largest surface."""
    found: list[Detection] = []
    taken = np.zeros(len(scan), dtype=bool)
    for surface, fitted in zip(surfaces, fits, strict=True):
        if taken[surface.candidate.rows].mean() > 0.5:
            continue
        detection, others = identify(surface, fitted)
        rejected += others
        if detection is not None:
            taken[surface.candidate.rows] = True
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
    patches = [
        patch
        for patch in find_patches(ordered, shortest=0.2 * width, longest=1.1 * diameter)
        # Tips, and rings that run on into something else, are not in the patch yet, so its area tells little.
        if patch.n_rings >= ordered.options.fewest_rings - 1 and 0.25 * least < patch.area < 1.5 * most
    ]
    candidates = []
    for candidate in grow(ordered, patches, 1.5 * diameter):
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
