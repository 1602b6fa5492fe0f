"""What a session's scans show of the targets in them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.crops import planar_returns
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.detection import Detections, Search, detect_in_scans, unsearchable
from optshape_graph.errors import AnotherSensorError, EstimationError, InputError
from optshape_graph.factors import EDGE_OFFSET, OF_RANGES, OF_RINGS, BiasedMeasurement, SharedError
from optshape_graph.factors._rows import triangular
from optshape_graph.io import Session, read_scan
from optshape_graph.pose import PoseEstimate, estimate_pose, estimate_poses
from optshape_graph.runs.files import fingerprint
from optshape_graph.runs.kept import Kept
from optshape_graph.runs.tasks import batches
from optshape_graph.scan import Scan
from optshape_graph.se3 import adjoint, vec_derivative
from optshape_graph.target import Target

ScanKey = tuple[Path, str, str]
"""File, LiDAR and target."""

ScanResult = TargetInScan | EstimationError | InputError

KEPT_EDGE_OFFSET = SharedError("edge offset that stays")


def read_scans(
    session: Session,
    tasks: Mapping[tuple[Path, str], list[str]],
    are_crops: bool,
    tick: Callable[[], None],
    unused: Counter[str],
    kept: Kept,
) -> dict[ScanKey, ScanResult]:
    """Find targets in scans, by file, LiDAR and target.

    Raises:
        InputError: the sensor file of a LiDAR is another model's: half of its scans or more do not fit it.
    """
    results: dict[ScanKey, ScanResult] = {}
    look = _in_crops if are_crops else _in_scans
    for some in batches(tasks.items(), CROPS_AT_ONCE if are_crops else SCANS_AT_ONCE):
        results.update(look(session, dict(some), tick, unused, kept))
    for lidar in session.lidars:
        _check_model(session, lidar, {path: one for (path, of, _), one in results.items() if of == lidar})
    return results


def _check_model(session: Session, lidar: str, results: Mapping[Path, ScanResult]) -> None:
    unfit = [one for one in results.values() if isinstance(one, AnotherSensorError)]
    if unfit and 2 * len(unfit) >= len(results):
        path, of = session.path, session.lidars[lidar]
        raise InputError(
            f"{path}: the sensor file of '{lidar}' ({session.sensor_files.get(lidar, of.name)}) is of another model: "
            f"it is for {of.name}, and {len(unfit)} of {len(results)} scans do not fit its elevations; "
            f"{relative_to(session, Path(unfit[0].name))}: {unfit[0].found}"
        )


SCANS_AT_ONCE = 8
"""Whole scans in which targets are looked for at once."""


def _in_scans(
    session: Session,
    tasks: Mapping[tuple[Path, str], list[str]],
    tick: Callable[[], None],
    unused: Counter[str],
    kept: Kept,
) -> dict[ScanKey, ScanResult]:
    """Find targets in some whole scans by detection, all at once."""
    results: dict[ScanKey, ScanResult] = {}
    scans: dict[tuple[Path, str], Scan] = {}
    for (path, lidar), names in tasks.items():
        try:
            scan = read_scan(path, session.lidars[lidar], unused=unused)
            if (error := unsearchable(scan)) is not None:
                raise error
            scans[path, lidar] = scan
        except (EstimationError, InputError) as error:
            results.update(dict.fromkeys([(path, lidar, name) for name in names], error))
        tick()
    steps = [
        {
            "scan": fingerprint([str(path)]), "crop": False, "lidar": lidar, "sensor": session.lidars[lidar],
            "targets": {name: session.targets[name] for name in tasks[path, lidar]},
        }
        for path, lidar in scans
    ]  # fmt: skip

    def detected() -> list[dict[str, TargetInScan | str] | EstimationError]:
        named = [tuple(replace(session.targets[name], name=name) for name in tasks[task]) for task in scans]
        found = detect_in_scans([Search(scan, own) for scan, own in zip(scans.values(), named, strict=True)])
        return [
            _detected(scan, lidar, tasks[path, lidar], detections)
            for ((path, lidar), scan), detections in zip(scans.items(), found, strict=True)
        ]

    together = kept.together(Mapping[str, TargetInScan | str], steps, detected)
    for (task, scan), seen in zip(scans.items(), together, strict=True):
        for name in tasks[task]:
            one = seen if isinstance(seen, EstimationError) else seen[name]
            one = EstimationError(one) if isinstance(one, str) else one
            results[*task, name] = one if isinstance(one, EstimationError) else replace(one, all_returns=scan.points)
    return {(*task, name): results[*task, name] for task, names in tasks.items() for name in names}


CROPS_AT_ONCE = 16
"""Crops in which targets' poses are estimated at once."""


def _in_crops(
    session: Session,
    tasks: Mapping[tuple[Path, str], list[str]],
    tick: Callable[[], None],
    unused: Counter[str],
    kept: Kept,
) -> dict[ScanKey, ScanResult]:
    """Find the target in each of some crops, all at once."""
    results: dict[ScanKey, ScanResult] = {}
    crops: dict[ScanKey, Scan] = {}
    for (path, lidar), names in tasks.items():
        try:
            scan = read_scan(path, session.lidars[lidar], unused=unused)
            if len(names) > 1:
                raise InputError(f"{path}: a crop of {len(names)} targets ({', '.join(names)}); expected one a view")
            crops[path, lidar, names[0]] = scan
        except (EstimationError, InputError) as error:
            results.update(dict.fromkeys([(path, lidar, name) for name in names], error))
        tick()
    steps = [
        {
            "scan": fingerprint([str(path)]), "crop": True, "lidar": lidar, "sensor": session.lidars[lidar],
            "targets": {name: session.targets[name]},
        }
        for path, lidar, name in crops
    ]  # fmt: skip
    found = kept.together(TargetInScan, steps, lambda: _cleaned(session, crops))
    for (key, scan), seen in zip(crops.items(), found, strict=True):
        results[key] = seen if isinstance(seen, EstimationError) else replace(seen, all_returns=scan.points)
    return {(*task, name): results[*task, name] for task, names in tasks.items() for name in names}


def _cleaned(session: Session, crops: Mapping[ScanKey, Scan]) -> list[TargetInScan | EstimationError]:
    """Clean crops, and estimate the poses of the targets in them."""
    found: dict[ScanKey, TargetInScan | EstimationError] = {}
    planar: dict[ScanKey, Scan] = {}
    for key, scan in crops.items():
        try:
            planar[key] = planar_returns(scan)
        except EstimationError as error:
            found[key] = error
    estimates = estimate_poses(list(planar.values()), [session.targets[name] for _, _, name in planar])
    for (key, returns), estimate in zip(planar.items(), estimates, strict=True):
        _, lidar, name = key
        try:
            if isinstance(estimate, EstimationError):
                raise estimate
            found[key] = target_in_scan(returns, session.targets[name], lidar, estimate)
        except EstimationError as error:
            found[key] = error
    return [found[key] for key in crops]


def _detected(
    scan: Scan, lidar: str, names: Sequence[str], detections: Detections | InputError
) -> dict[str, TargetInScan | str] | EstimationError:
    """What a full scan shows of targets, of several of one kind the most certain; or say why there is none."""
    if isinstance(detections, InputError):
        raise detections
    results: dict[str, TargetInScan | str] = {}
    for name in names:
        found = [one for one in detections.found if one.target.name == name and one.estimate.status != "failed"]
        if found:
            best = max(found, key=lambda one: one.score)
            try:
                results[name] = target_in_scan(scan.select(best.indices), best.target, lidar, best.estimate)
            except EstimationError as error:
                return error
        else:
            closest = max(detections.rejected, key=lambda one: one.area, default=None)
            why = f"; the largest surface turned down: {closest.reason}" if closest else ""
            results[name] = f"{scan.name}: target '{name}' not found in the scan{why}"
    return results


def target_in_scan(
    returns: Scan, target: Target, lidar: str, estimate: PoseEstimate | None = None, scan: Scan | None = None
) -> TargetInScan:
    """Return what a scan's returns on a target say, for calibration.

    Args:
        returns: the returns on the target and no others.
        target: the target.
        lidar: name of the LiDAR.
        estimate: of these returns, if there is one already.
        scan: the whole scan, for overlays.

    Raises:
        EstimationError: no pose can be estimated, or it is not to be used.
    """
    estimate = estimate_pose(returns, target) if estimate is None else estimate
    if estimate.status == "failed" or estimate.shared is None:
        raise EstimationError(f"{returns.name}: {estimate.reason}")
    shared, shared_effect = _shared_errors(estimate)
    passing = [error for error in estimate.shared.shared if not persists(error)]
    return TargetInScan(
        lidar=lidar,
        scan=returns.name,
        T_lidar_target=estimate.T_lidar_target,
        covariance=estimate.covariance,
        measurement=estimate.measurement,
        uncorrected=estimate.shared.marginal([float(e.kind not in OF_RANGES) for e in estimate.shared.shared]),
        shared=shared,
        shared_effect=shared_effect,
        persistent=_keeping_edge_offset(estimate.shared).without(passing),
        bias_factor=estimate.fit.bias_factor,
        edge_inset=estimate.inset_rad,
        doubt=estimate.reason if estimate.status == "doubtful" else "",
        own=returns,
        all_returns=(scan or returns).points,
    )


def persists(error: SharedError) -> bool:
    """Return whether an error is the LiDAR's own, in every scan: a ring's, or an offset of edges that stays."""
    return error == KEPT_EDGE_OFFSET or (error.ring is not None and error.kind in OF_RINGS)


def _keeping_edge_offset(shared: BiasedMeasurement) -> BiasedMeasurement:
    """Add an edge offset that the LiDAR keeps to that of each scan: as large, for no file says which of them it has.

    Scans' own offsets average away. One that stays does not, and by the apparent size of targets it looks like a range.
    """
    index = [k for k, error in enumerate(shared.shared) if error.kind == EDGE_OFFSET]
    if not index:
        return shared
    stack = triangular(np.hstack([shared.stack[:, index], shared.stack]))
    return replace(shared, stack=stack, shared=(KEPT_EDGE_OFFSET, *shared.shared))


def _shared_errors(estimate: PoseEstimate) -> tuple[tuple[SharedError, ...], Floats]:
    """Return the errors of rings that move the pose, and how: (6, K), right perturbation of T_lidar_target.

    The estimate allows for errors delta of its own; beside true ones beta it minimises
    ||S_pose x + S_bias (delta + beta) ||^2 + ||delta||^2.
    """
    assert estimate.shared is not None
    stack, errors = estimate.shared.stack, estimate.shared.shared
    k = len(errors)
    by_pose = stack[:, k:-1] @ vec_derivative(estimate.T_target_lidar)
    rows = np.block([[by_pose, stack[:, :k]], [np.zeros((k, 6)), np.eye(k)]])
    rings = [j for j, error in enumerate(errors) if error.kind in OF_RINGS]
    biases = np.vstack([stack[:, rings], np.zeros((k, len(rings)))])
    x = np.linalg.lstsq(rows, -biases, rcond=None)[0][:6]
    # (T Exp(x))^-1 = T^-1 Exp(-Ad(T) x)
    return tuple(errors[j] for j in rings), np.asarray(-adjoint(estimate.T_target_lidar) @ x)


def relative_to(session: Session, path: Path) -> str:
    """Return a path as messages show it, from the session's folder."""
    folder = session.path.parent
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)
