"""A session's files to views: what each scan and each image shows of the targets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock

from scipy.cluster.hierarchy import DisjointSet

from optshape_graph.calibration.camera.checks import check_session
from optshape_graph.calibration.camera.scans import ScanKey, ScanResult, read_scans, relative_to
from optshape_graph.calibration.camera.sightings import TargetInScan, View
from optshape_graph.calibration.images.reading import ImageTask, TargetInImage, find_targets
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io import Session
from optshape_graph.io import View as Entry
from optshape_graph.io.passed_over import UNUSABLE, PassedOver
from optshape_graph.runs.kept import Kept

Progress = Callable[[int, int], None]
"""Called with how many files are done, and how many there are."""

ImageKey = tuple[Path, str, str]
"""File, camera and target."""

ImageResult = TargetInImage | EstimationError | InputError


def read_views(
    session: Session,
    use_target_points: bool = False,
    progress: Progress | None = None,
    passed_over: PassedOver | None = None,
    kept: Kept | None = None,
) -> list[View]:
    """Find the session's targets in its scans and images.

    A file that cannot be read or shows no target becomes a view's `problem`, so that the others still count.

    Args:
        session: with at least one camera.
        use_target_points: whether to take the target's returns from the views' manual crops.
        progress: called as images and scans are done.
        passed_over: counts the scans and images that show nothing, and the clouds' fields that are not used.
        kept: what a run that was stopped found, and this one finds; None: it is not kept.

    Raises:
        InputError: what `check_session` says; crops that were asked for are missing; the intrinsics fit half of the
            images or fewer; or the sensor file of a LiDAR is of another model.
        EstimationError: no image, or no scan, shows a target; the message has the reason of each.
    """
    check_session(session)
    scans, images = read_files(session, use_target_points, progress, passed_over, kept)
    check_found(session, scans.values(), TargetInScan, "scan")
    placements = moments_of(session.views)
    views = []
    for number, entry in enumerate(session.views):
        for name in entry.targets:
            scan = scans[scan_file(entry, use_target_points), entry.lidar, name]
            image = images.get((entry.image, entry.camera, name)) if entry.image and entry.camera else None
            problems = [str(found) for found in (scan, image) if isinstance(found, Exception)]
            views.append(
                View(
                    placement=f"{placements[number]}:{name}",
                    target=replace(session.targets[name], name=name),  # two boards of one file are two boards
                    scan=scan if isinstance(scan, TargetInScan) else None,
                    image=image if isinstance(image, TargetInImage) else None,
                    scan_name=relative_to(session, entry.cloud),
                    image_name=relative_to(session, entry.image) if entry.image else "",
                    problem="; ".join(problems),
                )
            )
    return views


def read_files(
    session: Session,
    use_target_points: bool,
    progress: Progress | None,
    passed_over: PassedOver | None,
    kept: Kept | None,
) -> tuple[dict[ScanKey, ScanResult], dict[ImageKey, ImageResult]]:
    """Find the session's targets in its scans and in its images, each by file, sensor and target.

    Args:
        session: of any sensors.
        use_target_points: whether to take the target's returns from the views' manual crops.
        progress: called as images and scans are done.
        passed_over: counts the scans and images that show nothing, and the clouds' fields that are not used.
        kept: what a run that was stopped found, and this one finds; None: it is not kept.

    Raises:
        InputError: crops that were asked for are missing; the intrinsics fit half of the images or fewer; or the
            sensor file of a LiDAR is of another model.
        EstimationError: no image, though there are some, shows a target; the message has the reason of each.
    """
    of_images, of_scans = image_tasks(session), scan_tasks(session, use_target_points)
    total, done, lock = len(of_images) + len(of_scans), 0, Lock()

    def tick() -> None:
        nonlocal done
        with lock:
            done += 1
            if progress is not None:
                progress(done, total)

    kept, passed_over = kept or Kept(), PassedOver() if passed_over is None else passed_over
    images = read_images(session, of_images, tick, kept) if of_images else {}
    scans = read_scans(session, of_scans, use_target_points, tick, passed_over.unused("scans"), kept)
    count_skipped(passed_over, "scans", scans)
    count_skipped(passed_over, "images", images)
    return scans, images


def image_tasks(session: Session) -> dict[ImageKey, ImageTask]:
    """Return the targets to look for in each image of each camera."""
    return {
        (entry.image, entry.camera, name): ImageTask(
            entry.image, session.targets[name], replace(session.cameras[entry.camera], name=entry.camera), entry.corners
        )
        for entry in session.views
        if entry.image is not None and entry.camera is not None
        for name in entry.targets
    }


def scan_tasks(session: Session, use_target_points: bool) -> dict[tuple[Path, str], list[str]]:
    """Return the targets to look for in each scan of each LiDAR."""
    wanted: dict[tuple[Path, str], list[str]] = {}
    for entry in session.views:
        if entry.scan is None:
            continue
        names = wanted.setdefault((scan_file(entry, use_target_points), entry.lidar), [])
        names.extend(name for name in entry.targets if name not in names)
    return wanted


def read_images(
    session: Session, tasks: Mapping[ImageKey, ImageTask], tick: Callable[[], None], kept: Kept
) -> dict[ImageKey, ImageResult]:
    """Find targets in images.

    Raises:
        InputError: the intrinsics fit half of the images or fewer.
        EstimationError: no image shows a target.
    """
    found = find_targets(list(tasks.values()), tick, kept)
    unfit = [error for error in found if isinstance(error, InputError)]
    shown = sum(isinstance(one, TargetInImage) for one in found)
    if unfit and shown <= len(unfit):
        others = f" ({len(unfit)} of {len(unfit) + shown} images do not fit)" if len(unfit) > 1 else ""
        raise InputError(f"{unfit[0]}{others}")
    check_found(session, found, TargetInImage, "image")
    return dict(zip(tasks, found, strict=True))


def check_found(session: Session, found: Iterable[object], kind: type, what: str) -> None:
    """Raise with the reasons where no file shows a target.

    Raises:
        EstimationError: none does.
    """
    results = list(found)
    if not any(isinstance(one, kind) for one in results):
        folder = f"{session.path.parent}/"
        reasons = dict.fromkeys(str(one).replace(folder, "") for one in results)
        raise EstimationError(f"{session.path}: no {what} shows a target: {'; '.join(reasons)}")


def count_skipped(passed_over: PassedOver, source: str, results: Mapping[tuple[Path, str, str], object]) -> None:
    """Count the files that show none of their targets, by what the first of them says."""
    files: dict[Path, list[object]] = {}
    for (path, _, _), result in results.items():
        files.setdefault(path, []).append(result)
    for found in files.values():
        if all(isinstance(one, Exception) for one in found):
            passed_over.skip(source, UNUSABLE if isinstance(found[0], InputError) else "no target found")


def scan_file(entry: Entry, use_target_points: bool) -> Path:
    """Return a view's file: the cloud, or the target's returns cropped by hand.

    Raises:
        InputError: the view has none.
    """
    if not use_target_points:
        return entry.cloud
    if entry.target_points is None:
        raise InputError(f"{entry.cloud}: the view has no 'target_points', which were asked for")
    return entry.target_points


def moments_of(entries: Sequence[Entry]) -> list[int]:
    """Return a number for each view, the same where they share a scan, an image or a stamp."""
    groups = DisjointSet(range(len(entries)))
    first: dict[object, int] = {}
    for number, entry in enumerate(entries):
        marks = {"scan": entry.scan, "image": entry.image, "stamp": entry.stamp, "frame": entry.mocap_frame}
        for mark in marks.items():
            if mark[1] is not None:
                groups.merge(first.setdefault(mark, number), number)
    return [groups[number] for number in range(len(entries))]
