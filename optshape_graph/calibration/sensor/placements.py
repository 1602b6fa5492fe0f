"""Where boards stood still: from the scans of a session or a recording, target by target, revolution by revolution."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.mocap.session import load_mocap_scans
from optshape_graph.detection import Detections, Search, detect_in_scans
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.gaussian import chi_square_tail
from optshape_graph.io.clouds import read_scan
from optshape_graph.io.recordings import Recording
from optshape_graph.io.sessions import Session
from optshape_graph.pose import PoseEstimate, estimate_poses
from optshape_graph.runs.files import fingerprint
from optshape_graph.runs.kept import Kept
from optshape_graph.runs.tasks import batches
from optshape_graph.scan import Scan
from optshape_graph.se3 import angle
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

ALIKE = np.radians(1.5)
"""Up to this much the beams of a unit differ from its model's data sheet, rad."""

STILL = (0.02, np.radians(2.0))
"""Distance, metres, and angle, rad, from the run's first pose within which a board stands still: a step's noise. Who
carries one moves it by more from a revolution to the next."""

FEWEST_STILL = 4
"""Revolutions for which a board of a recording stands still at least: fewer, and it may have been on its way."""

MOVED = 1e-5
"""Probability of so much motion by chance, from the first revolution to the last, below which a board moved: of sixteen
hundred sessions of sixty placements, one loses one by chance."""

MOST_REVOLUTIONS = 8
"""Revolutions of a placement that take part, evenly spread: by then ring ends and ring errors limit it."""


@dataclass(frozen=True, eq=False, repr=False)
class Sighting(Value):
    """A board in one scan.

    Attributes:
        moment: number of the scan.
        name: of the scan.
        estimate: its pose.
        returns: its returns.
        markers: (n, 3) motion-capture markers near its vertices, metres, NaN where not seen; None: none.
    """

    moment: int
    name: str
    estimate: PoseEstimate
    returns: Scan
    markers: Floats | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Placement(Value):
    """A board that stood still for some revolutions.

    Attributes:
        sightings: of it, one for each revolution.
    """

    sightings: tuple[Sighting, ...]

    @property
    def target(self) -> Target:
        """The board."""
        return self.sightings[0].estimate.target

    @property
    def moment(self) -> int:
        """Number of its first scan."""
        return self.sightings[0].moment

    @property
    def distance(self) -> float:
        """From the sensor, metres."""
        return float(np.linalg.norm(self.sightings[0].estimate.T_lidar_target[:3, 3]))

    @property
    def markers(self) -> Floats | None:
        """(n, 3) motion-capture markers, metres, or None."""
        return self.sightings[0].markers

    def __repr__(self) -> str:
        return f"Placement({self.target.name!r} at {self.distance:.1f} m, {len(self.sightings)} revolutions)"


def gather(sightings: Iterable[Sighting], fewest: int = 1) -> tuple[Placement, ...]:
    """Return the placements of sightings in the order of time: runs in which a board stood still.

    Args:
        sightings: of all boards.
        fewest: revolutions of a placement at least.
    """
    return _placed(_runs(sightings), fewest)


def _runs(sightings: Iterable[Sighting]) -> dict[str, list[list[Sighting]]]:
    """Runs in which each board stood still, by its name."""
    runs: dict[str, list[list[Sighting]]] = {}
    for one in sightings:
        of_target = runs.setdefault(one.estimate.target.name, [])
        if of_target and one.markers is None and _still(of_target[-1][0], one):
            of_target[-1].append(one)
        else:
            of_target.append([one])
    return runs


def _placed(runs: Mapping[str, Sequence[Sequence[Sighting]]], fewest: int) -> tuple[Placement, ...]:
    """The placements of runs of so many revolutions at least, in the order of time."""
    placements = [
        Placement(tuple(run[k] for k in _spread(len(run))))
        for of_target in runs.values()
        for run in of_target
        if len(run) >= fewest
    ]
    return tuple(sorted(placements, key=lambda placement: placement.moment))


def at_rest(placements: Sequence[Placement]) -> tuple[tuple[Placement, ...], list[str]]:
    """Return the placements whose boards did not move, and the others in words."""
    kept, moved = [], []
    for one in placements:
        distance, probability = _motion(one)
        if probability >= MOVED:
            kept.append(one)
            continue
        first, last = one.sightings[0].name, one.sightings[-1].name
        moved.append(
            f"{one.target.name} from {first} to {last}: it moved by {1e3 * distance:.0f} mm while it should stand still"
        )
    return tuple(kept), moved


def _motion(placement: Placement) -> tuple[float, float]:
    """How far a board moves from its first revolution to its last, evenly, metres, and the probability by chance."""
    moments = np.array([one.moment for one in placement.sightings], float)
    if len(moments) < 3 or np.ptp(moments) == 0:
        return 0.0, 1.0
    since = (moments - moments[0]) / np.ptp(moments)
    information, pull = np.zeros((6, 6)), np.zeros(6)
    for s, one in zip(since, placement.sightings, strict=True):
        T = one.estimate.T_lidar_target
        J = np.hstack([np.eye(3), s * np.eye(3)])  # by where it is at first, and by its motion
        weight = np.linalg.inv(T[:3, :3] @ one.estimate.covariance[3:, 3:] @ T[:3, :3].T)
        information += J.T @ weight @ J
        pull += J.T @ weight @ T[:3, 3]
    motion, covariance = np.linalg.solve(information, pull)[3:], np.linalg.inv(information)[3:, 3:]
    return float(np.linalg.norm(motion)), chi_square_tail(float(motion @ np.linalg.solve(covariance, motion)), 3)


def _still(first: Sighting, one: Sighting) -> bool:
    a, b = first.estimate.T_lidar_target, one.estimate.T_lidar_target
    sd = first.estimate.sigma_m + one.estimate.sigma_m, first.estimate.sigma_rad + one.estimate.sigma_rad
    moved, turned = float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(angle(a[:3, :3].T @ b[:3, :3]))
    return moved < STILL[0] + 2 * sd[0] and turned < STILL[1] + 2 * sd[1]


def _spread(n: int) -> list[int]:
    return [int(k) for k in np.linspace(0, n - 1, min(n, MOST_REVOLUTIONS)).round()]


def one_lidar(session: Session, lidar: str | None, sensor: SensorModel | None) -> tuple[Session, SensorModel]:
    """Return a session of one of its LiDARs alone, and that LiDAR's sensor.

    Args:
        session: of any LiDARs.
        lidar: which one; None: the only one.
        sensor: that it is; None: as the session has it.

    Raises:
        InputError: several LiDARs and none named, none of that name, or a sensor of another model.
    """
    if lidar is None and len(session.lidars) != 1:
        raise InputError(f"{session.path}: one LiDAR is calibrated at a time; name one of {', '.join(session.lidars)}")
    name = next(iter(session.lidars)) if lidar is None else lidar
    if name not in session.lidars:
        raise InputError(f"{session.path}: no LiDAR '{name}'; found {', '.join(session.lidars)}")
    its = session.lidars[name]
    if sensor is None:
        sensor = its
    elif its.n_rings != sensor.n_rings or np.abs(its.elevations - sensor.elevations).max() > ALIKE:
        raise InputError(f"{session.path}: its sensor '{its.name}' is another model than '{sensor.name}'")
    views = tuple(view for view in session.views if view.lidar == name)
    return replace(session, lidars={name: sensor}, views=views), sensor


def of_session(
    session: Session,
    targets: Sequence[Target],
    use_target_points: bool,
    progress: Callable[[int, int], None],
    kept: Kept,
) -> tuple[tuple[Placement, ...], list[str]]:
    """Return the placements of a session's views, and what was left out, in words.

    Args:
        session: of one LiDAR; with motion capture, whose scans hold the target's returns alone, or with whole scans.
        targets: to look for; none: those of the session.
        use_target_points: take the crops by hand instead of looking for the boards.
        progress: called with the number of scans done, and their total.
        kept: what was found in a run that was stopped, and is in this one.

    Raises:
        InputError: a scan or markers that can't be read.
    """
    if session.mocap is not None:
        scans, left_out, _ = load_mocap_scans(session, progress=progress, kept=kept)
        sightings = [
            Sighting(k, scan.name, scan.estimate, scan.returns, scan.markers)
            for k, scan in enumerate(scans)
            if scan.estimate.status == "ok" and scan.returns is not None
        ]
        return gather(sightings), [f"{item.scan}: {item.reason}" for item in left_out]
    left_out_views: list[str] = []
    sensor = next(iter(session.lidars.values()))

    def looks() -> Iterator[_Look]:
        for k, view in enumerate(session.views):
            progress(k, len(session.views))
            wanted = targets or [session.targets[target] for target in view.targets]
            crop = view.target_points if use_target_points else None
            scan = read_scan(crop or view.cloud, sensor)
            of = {"scan": fingerprint([str(crop or view.cloud)]), "crop": crop is not None, "moment": k,
                  "sensor": sensor, "targets": wanted}  # fmt: skip
            yield _Look(k, scan, tuple(wanted), crop is not None, of)

    def seen() -> Iterator[Sighting]:
        for look, found in _seen(looks(), kept):
            if not found:
                left_out_views.append(f"{session.views[look.moment].cloud.name}: no board found")
            yield from found

    placements, moved = at_rest(gather(seen()))
    return placements, left_out_views + moved


def of_recording(
    recording: Recording,
    topic: str | None,
    targets: Sequence[Target],
    sensor: SensorModel,
    progress: Callable[[int, int], None],
    kept: Kept,
) -> tuple[tuple[Placement, ...], list[str]]:
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

    runs = _runs(one for _, found in _seen(looks(), kept) for one in found)
    left_out = [str(stream.skipped)] if stream.skipped else []
    for name, of_target in runs.items():
        if moving := sum(len(run) for run in of_target if len(run) < FEWEST_STILL):
            left_out.append(f"{moving} sightings of {name}: it stood still for fewer than {FEWEST_STILL} revolutions")
    placements, moved = at_rest(_placed(runs, FEWEST_STILL))
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
