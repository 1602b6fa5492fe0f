"""The placements of a session or a recording: which boards its scans show, and which of them stood still."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeAlias

from optshape_graph.calibration.camera.scans import relative_to
from optshape_graph.calibration.camera.session import moments_of
from optshape_graph.calibration.mocap.session import load_mocap_scans
from optshape_graph.calibration.sensor.placements import Placement, Sighting, placed, runs_of
from optshape_graph.calibration.sensor.rest import FEWEST_STILL, at_rest, standing
from optshape_graph.calibration.sensor.sources import scans_of
from optshape_graph.detection import Detections, Search, detect_in_scans
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.clouds import read_scan
from optshape_graph.io.recordings import Recording
from optshape_graph.io.sessions import Session
from optshape_graph.pose import PoseEstimate, estimate_poses
from optshape_graph.runs.files import fingerprint
from optshape_graph.runs.kept import Kept
from optshape_graph.runs.tasks import batches
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

Found: TypeAlias = tuple[tuple[Placement, ...], list[str]]
"""Placements, and what was left out, in words."""

STAYS = -1
"""The place of a board that is said to stay where it is in all views."""


def of_session(
    session: Session,
    targets: Sequence[Target],
    use_target_points: bool,
    progress: Callable[[int, int], None],
    kept: Kept,
) -> Found:
    """Return the placements of a session's views, and what was left out, in words.

    A board is in one place in views that share a stamp; in all of them if the session says that it is static and the
    platform does not move; else as its poses say. It is on its way in views that are moving.

    Args:
        session: of one LiDAR; with motion capture, whose scans hold the target's returns alone, or with whole scans.
        targets: to look for; none: those of the session.
        use_target_points: take the crops by hand instead of looking for the boards.
        progress: called with the number of scans done, and their total.
        kept: what was found in a run that was stopped, and is in this one.

    Raises:
        InputError: a scan or markers that can't be read.
    """
    still = tuple(view for view in session.views if not view.moving)
    left_out = [
        f"{relative_to(session, view.cloud)}: the session says that it is moving"
        for view in session.views
        if view.moving
    ]
    session = replace(session, views=still)
    if session.mocap is not None:
        placements, others = _captured(session, progress, kept)
        return placements, left_out + others
    scans, places = scans_of(session), moments_of(session.views)
    sensor = next(iter(session.lidars.values()))
    stays = session.static if not session.platform_moves else frozenset[str]()

    def looks() -> Iterator[_Look]:
        for k, (cloud, numbers) in enumerate(scans.items()):
            progress(k, len(scans))
            views = [session.views[n] for n in numbers]
            wanted = targets or [session.targets[name] for name in dict.fromkeys(n for v in views for n in v.targets)]
            crop = views[0].target_points if use_target_points else None
            scan = replace(read_scan(crop or cloud, sensor), name=relative_to(session, cloud))
            of = {"scan": fingerprint([str(crop or cloud)]), "crop": crop is not None, "moment": k,
                  "sensor": sensor, "targets": wanted}  # fmt: skip
            yield _Look(k, scan, tuple(wanted), crop is not None, of)

    def seen() -> Iterator[Sighting]:
        for (look, found), numbers in zip(_seen(looks(), kept), scans.values(), strict=True):
            if not found:
                left_out.append(f"{look.scan.name}: no board found whose pose is sure")
            for one in found:
                place = STAYS if one.estimate.target.name in stays else places[numbers[0]]
                yield replace(one, time=session.views[numbers[0]].stamp, place=place)

    runs, carried = standing(runs_of(seen()))
    placements, moved = at_rest(placed(runs))
    return placements, left_out + carried + moved


def _captured(session: Session, progress: Callable[[int, int], None], kept: Kept) -> Found:
    """The placements of a session with motion capture."""
    scans, left_out, _ = load_mocap_scans(session, progress=progress, kept=kept)
    sightings = [
        Sighting(k, scan.name, scan.estimate, scan.returns, scan.markers, place=scan.frame)
        for k, scan in enumerate(scans)
        if scan.estimate.status == "ok" and scan.returns is not None
    ]
    runs, carried = standing(runs_of(sightings))
    placements, moved = at_rest(placed(runs))
    return placements, [*(f"{item.scan}: {item.reason}" for item in left_out), *carried, *moved]


def of_recording(
    recording: Recording,
    topic: str | None,
    targets: Sequence[Target],
    sensor: SensorModel,
    progress: Callable[[int, int], None],
    kept: Kept,
) -> Found:
    """Return the placements of a recording, and what was left out, in words.

    Args:
        recording: of one LiDAR that stands still, or is moved between placements only.
        topic: of its scans; None: the only one.
        targets: to look for.
        sensor: that made it.
        progress: called with the number of scans done, and their total.
        kept: what was found in a run that was stopped, and is in this one.
    """
    stream = recording.scans(topic, sensor)

    def looks() -> Iterator[_Look]:
        for k, stamped in enumerate(stream):
            progress(k, stream.expected or k + 1)
            scan = stamped.value
            of = {"scan": fingerprint([str(recording.path), scan.name]), "topic": topic, "moment": k, "sensor": sensor,
                  "targets": targets}  # fmt: skip
            yield _Look(k, scan, tuple(targets), False, of)

    runs = runs_of(one for _, found in _seen(looks(), kept) for one in found)
    left_out = [str(stream.skipped)] if stream.skipped else []
    for name, of_board in runs.items():
        if moving := sum(len(run) for run in of_board if len(run) < FEWEST_STILL):
            left_out.append(f"{moving} sightings of {name}: it stood still for fewer than {FEWEST_STILL} revolutions")
    placements, moved = at_rest(placed(runs, FEWEST_STILL))
    return placements, left_out + moved


AT_ONCE = 8
"""Scans in which boards are looked for at once."""


class _Look(NamedTuple):
    """A scan in which boards are looked for: its number, the boards, and what tells it from others.

    A crop shows the first board alone.
    """

    moment: int
    scan: Scan
    targets: tuple[Target, ...]
    crop: bool
    of: Mapping[str, Any]


def _seen(looks: Iterable[_Look], kept: Kept) -> Iterator[tuple[_Look, tuple[Sighting, ...]]]:
    """Yield scans and the boards that they show, some at once.

    Raises:
        InputError: a scan in which no targets can be found.
    """
    for some in batches(looks, AT_ONCE):
        found = kept.together(tuple[Sighting, ...], [look.of for look in some], partial(_boards, some))
        for look, boards in zip(some, found, strict=True):
            assert not isinstance(boards, EstimationError)  # a scan without boards has none
            yield look, boards


def _boards(looks: Sequence[_Look]) -> list[tuple[Sighting, ...]]:
    """Find the boards that scans show, all at once.

    Raises:
        InputError: a scan in which no targets can be found.
    """
    crops, whole = ([one for one in looks if one.crop is crop] for crop in (True, False))
    estimates = iter(estimate_poses([one.scan for one in crops], [one.targets[0] for one in crops]))
    detections = iter(detect_in_scans([Search(one.scan, one.targets) for one in whole]))
    return [_cropped(one, next(estimates)) if one.crop else _detected(one, next(detections)) for one in looks]


def _detected(look: _Look, detections: Detections | InputError) -> tuple[Sighting, ...]:
    if isinstance(detections, InputError):
        raise detections
    return tuple(
        Sighting(look.moment, look.scan.name, found.estimate, look.scan.select(found.indices))
        for found in detections.found
        if found.estimate.status == "ok"
    )


def _cropped(look: _Look, estimate: PoseEstimate | EstimationError) -> tuple[Sighting, ...]:
    if isinstance(estimate, EstimationError) or estimate.status != "ok":
        return ()
    return (Sighting(look.moment, look.scan.name, estimate, look.scan),)
