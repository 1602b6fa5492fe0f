"""LiDAR-camera calibration from views of targets: start, joint solution, rejection of bad views, evidence."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from optshape_graph.calibration.camera.consistency import (
    LIMIT,
    describe,
    estimate_discrepancy,
    of_view,
    scatter,
    squared_distances,
)
from optshape_graph.calibration.camera.evidence import CrossValidation, ViewErrors, view_errors
from optshape_graph.calibration.camera.factors import LENS, CompiledCamera
from optshape_graph.calibration.camera.graph import CalibrationGraph, Discrepancy, Rig, Sighting, Unknowns
from optshape_graph.calibration.camera.judgement import judge
from optshape_graph.calibration.camera.lens import check_lenses
from optshape_graph.calibration.camera.noise import with_estimated_pixel_noise
from optshape_graph.calibration.camera.observability import check_observable
from optshape_graph.calibration.camera.result import CameraCalibration, ViewResult, measure_shapes, middle
from optshape_graph.calibration.camera.session import read_views
from optshape_graph.calibration.camera.sightings import TargetInScan, View
from optshape_graph.calibration.camera.start import Start, find_start
from optshape_graph.calibration.images.image_points import turn_about
from optshape_graph.calibration.verdict import Finding
from optshape_graph.errors import EstimationError, InputError, UnobservableError, expect
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.sessions import Session, load_session
from optshape_graph.runs.kept import Kept

ANOTHER_LENS = (
    "views agree only where lenses are others than given: let them be refined, or calibrate the cameras again; what is "
    "stated is for the lenses as given"
)
"""What is found where it is."""

FOLDS = 5

SETTLING = 5
"""Solutions after which the discrepancy is taken as it is."""

Progress = Callable[[int, int], None]
"""Called with how many solutions are done, and how many there are."""


def calibrate_camera(
    session: str | Path | Session,
    *,
    use_target_points: bool = False,
    refine_intrinsics: bool | None = None,
    range_bias_sigma: float = Unknowns.range_bias_sigma,
    progress: Progress | None = None,
    kept: Kept | None = None,
) -> CameraCalibration:
    """Calibrate T_camera_lidar of a session's LiDARs and cameras, and say how far to trust it.

    Args:
        session: its file, or what `load_session` returned.
        use_target_points: take the targets' returns from the views' manual crops.
        refine_intrinsics: whether the cameras' lenses are refined, the given ones being a prior; None: those that the
            images contradict.
        range_bias_sigma: prior standard deviation of a LiDAR's range bias, metres; 0: it has none.
        progress: called with how many images, scans and solutions are done, and how many there are.
        kept: what a run that was stopped found in scans and images, and this one finds (`runs.kept.keeping`); None: it
            is not kept.

    Raises:
        InputError: a session that can't be read or used as it is: see `check_session`; or a lens that fits none of the
            images, or is to be refined and can't be.
        EstimationError: no target was found, or the views contradict each other; the message has the reasons.
        UnobservableError: the views leave directions of the extrinsic open, which it names.
    """
    expect("session", session, str, Path, Session)
    loaded = session if isinstance(session, Session) else load_session(session)
    if refine_intrinsics:
        for camera in loaded.cameras.values():
            CompiledCamera.of(camera).check_refinable()
    passed_over = PassedOver()
    views = read_views(loaded, use_target_points, progress, passed_over, kept)
    result = calibrate(views, Unknowns(range_bias_sigma, refine_intrinsics), progress)
    return replace(result, passed_over=passed_over)


def calibrate(
    views: Sequence[View], unknowns: Unknowns | None = None, progress: Progress | None = None
) -> CameraCalibration:
    """Calibrate LiDARs and cameras jointly from views of targets; no initial guess is needed.

    Args:
        views: of all sensors.
        unknowns: what is estimated beside the extrinsics.
        progress: called as the cross-validation advances.

    Raises:
        EstimationError: the views are too few, or contradict each other.
        InputError: they agree only if the numbers of the chessboard's corners stand in the other order.
        UnobservableError: the views leave directions of the extrinsic open, which it names.
    """
    views, unknowns = with_estimated_pixel_noise(views), unknowns or Unknowns()
    start = _start(views)
    base, cameras = next(iter(start.rig.T_base_sensor)), tuple(start.rig.cameras)
    lidars = dict.fromkeys([base, *(s.sensor for s in start.sightings if isinstance(s.seen, TargetInScan))])
    lenses = check_lenses(view.image for view in views if view.image is not None)
    wrong = {lens.camera for lens in lenses if lens.contradicted}
    refined = frozenset({None: wrong, True: set(cameras), False: set[str]()}[unknowns.intrinsics])

    def graph_of(free_lenses: Collection[str]) -> CalibrationGraph:
        return CalibrationGraph(start.sightings, base, unknowns.range_bias_sigma, free_lenses)

    def graph_as_they_come(free_lenses: Collection[str]) -> CalibrationGraph:
        return CalibrationGraph(start.sightings, base, 0.0, free_lenses, as_they_come=True)

    everything_free, findings = graph_of(cameras), list[Finding]()
    best, used, squared, discrepancy = _solve_robustly(graph_of(refined), start, views)
    if refined != set(cameras) and set(squared) - used:
        # Views disagree: where they do not under a lens as near to the given one as that is good for, it is the lens.
        free, agreeing, distances, _ = _solve_robustly(everything_free, start, views)
        if agreeing > used:
            used, squared = agreeing, distances
            best, discrepancy = _settled(graph_of(refined), start, replace(free, cameras=start.rig.cameras), used)
            findings.append(Finding(ANOTHER_LENS, True))
    taking_part = {s.sensor for s in start.sightings if used & set(s.views)}
    if missing := sorted(set(start.rig.T_base_sensor) - taking_part):
        raise EstimationError(f"no view of {', '.join(missing)} agrees with those of the other sensors")
    scans = [s for s in start.sightings if s.sensor == base and used & set(s.views)]
    # What is not known of the lenses, refined or not, is part of what is not known of the cameras' places. With a lens
    # that is not quite as given, scans and images differ by more than they scatter: settled with the lens free.
    most_likely, discrepancy = _settled(everything_free, start, best, used, len(LENS) * len(cameras))
    uncertainty = everything_free.uncertainty(used.__contains__, most_likely, discrepancy)
    check_observable(uncertainty, middle(scans))
    graph = graph_as_they_come(refined)
    rig, discrepancy = _settled(graph, start, best, used)
    given = graph_as_they_come(()).solve(used.__contains__, replace(rig, cameras=start.rig.cameras), discrepancy)
    left_out, k_fold = _cross_validations(graph, start, rig, discrepancy, views, used, progress)
    errors = _errors(start.sightings, views, rig, range(len(views))) | left_out.views
    limit = LIMIT * scatter(squared, used)
    results = [
        ViewResult(
            view,
            k in used,
            "" if k in used else _reason(k, views, start, best, discrepancy, squared, limit),
            errors.get(k),
        )
        for k, view in enumerate(views)
    ]
    result = CameraCalibration(
        lidars=tuple(lidars),
        cameras=cameras,
        rig=rig,
        corrected=best if unknowns.range_bias_sigma > 0 else None,
        given=given if refined else None,
        most_likely=most_likely,
        uncertainty=uncertainty,
        views=tuple(results),
        cross_validations=(left_out, k_fold),
        discrepancy=discrepancy,
        lenses=lenses,
        refined=refined,
        shapes=measure_shapes(results),
        findings=(),
        sightings=start.sightings,
    )
    return replace(result, findings=(*findings, *judge(result, unknowns)))


def _start(views: Sequence[View]) -> Start:
    """Find the start, or say that the numbers of the chessboards' corners stand in the wrong order, if they do."""
    try:
        return find_start(views)
    except UnobservableError:
        raise
    except EstimationError as error:
        turned = [_turned(view) for view in views]
        with suppress(EstimationError):
            find_start(turned)
            raise InputError(
                f"{error}; they agree with the two numbers of 'inner_corners' in the other order"
            ) from error
        raise


def _turned(view: View) -> View:
    """Return a view with its chessboard read as if its rows were columns: turned by a quarter."""
    board, image = view.target.chessboard, view.image
    if board is None or image is None:
        return view
    quarters = tuple(turn_about(board.offset, k * np.pi / 2) for k in (1, 3))
    return replace(view, image=replace(image, points=replace(image.points, symmetries=quarters)))


def _reason(
    number: int,
    views: Sequence[View],
    start: Start,
    rig: Rig,
    discrepancy: Discrepancy,
    squared: Mapping[int, float],
    limit: float,
) -> str:
    """Say why a view takes no part."""
    if number not in squared:
        return views[number].problem or "no other sensor saw the target at that time"
    return describe(number, views, start.sightings, rig, discrepancy, limit)


def _solve_robustly(
    graph: CalibrationGraph, start: Start, views: Sequence[View]
) -> tuple[Rig, set[int], dict[int, float], Discrepancy]:
    """Solve, take out the worst view or take in those that turn out to agree, until nothing changes."""
    used, rig, discrepancy, squared = set(start.agreeing), start.rig, Discrepancy(), dict[int, float]()
    for _ in range(2 * len(start.sightings) + 10):
        if len(used) < 2:
            reasons = [
                f"{view.name}: {_reason(k, views, start, rig, discrepancy, squared, LIMIT)}"
                for k, view in enumerate(views) if k not in used
            ]  # fmt: skip
            raise EstimationError(
                f"{len(used)} view in which all sensors agree; a calibration needs at least 2, and 10 to be trusted; "
                f"{'; '.join(reasons)}"
            )
        rig = graph.solve(used.__contains__, rig, discrepancy)
        squared = squared_distances(start.sightings, rig, discrepancy)
        limit = LIMIT * scatter(squared, used)
        worst = max(used, key=lambda view: squared[view])
        agreeing = {view for view, value in squared.items() if value <= limit / 2}
        if squared[worst] > limit:
            used.remove(worst)
        elif not agreeing <= used:
            used |= agreeing
        else:
            previous, discrepancy = discrepancy, estimate_discrepancy(start.sightings, rig, used)
            if _alike(previous, discrepancy):
                break
    return rig, used, squared, discrepancy


def _settled(
    graph: CalibrationGraph, start: Start, rig: Rig, used: set[int], fitted: int = 0
) -> tuple[Rig, Discrepancy]:
    """Solve over the used views with the discrepancy that the solution itself shows."""
    discrepancy = estimate_discrepancy(start.sightings, rig, used, fitted)
    for _ in range(SETTLING):
        rig = graph.solve(used.__contains__, rig, discrepancy)
        previous, discrepancy = discrepancy, estimate_discrepancy(start.sightings, rig, used, fitted)
        if _alike(previous, discrepancy):
            break
    return rig, discrepancy


def _alike(a: Discrepancy, b: Discrepancy) -> bool:
    return bool(np.allclose(np.log(a.sigmas / b.sigmas), 0.0, atol=0.05))


def _cross_validations(
    graph: CalibrationGraph,
    start: Start,
    rig: Rig,
    discrepancy: Discrepancy,
    views: Sequence[View],
    used: set[int],
    progress: Progress | None,
) -> tuple[CrossValidation, CrossValidation]:
    numbers = sorted(used)
    k = min(FOLDS, len(numbers))
    protocols = (
        ("leave-one-out", [[number] for number in numbers]),
        (f"k-fold, k = {k}", [numbers[i::k] for i in range(k)]),
    )
    total, done, found = len(numbers) + k, 0, []
    for protocol, folds in protocols:
        errors: dict[int, ViewErrors] = {}
        for fold in folds:
            others = used - set(fold)
            without = graph.solve(others.__contains__, rig, discrepancy)
            errors |= _errors(start.sightings, views, without, fold)
            done += 1
            if progress is not None:
                progress(done, total)
        found.append(CrossValidation(protocol, errors))
    return found[0], found[1]


def _errors(
    sightings: Sequence[Sighting], views: Sequence[View], rig: Rig, numbers: Iterable[int]
) -> dict[int, ViewErrors]:
    errors = {}
    for number in numbers:
        scan, image = of_view(number, sightings)
        if scan is not None and image is not None and {scan.sensor, image.sensor} <= set(rig.T_base_sensor):
            errors[number] = view_errors(scan, image, views[number].target, rig)
    return errors
