"""What boards were recorded in: sessions and recordings, opened and checked before the work."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from optshape_graph._arrays import Value
from optshape_graph.calibration.camera.scans import relative_to
from optshape_graph.calibration.sensor.known import Distance, point_of
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.recordings import Recording
from optshape_graph.io.sessions import Session, load_session
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

ALIKE = np.radians(1.5)
"""Up to this much the beams of a unit differ from its model's data sheet, rad."""

FEWEST = 6
"""Placements at least: two thirds of them calibrate, the others judge."""

Source: TypeAlias = str | Path | Session | Recording
"""What boards were recorded in."""


@dataclass(frozen=True, eq=False, repr=False)
class Opened(Value):
    """Sources that are opened, and go together.

    Attributes:
        sources: recordings, and sessions of one LiDAR each, whose targets have the names that the session gives them.
        sensor: the sensor's file, the prior.
        targets: to look for; of sessions those that they name, if there are none.
    """

    sources: tuple[Session | Recording, ...]
    sensor: SensorModel
    targets: tuple[Target, ...]

    @classmethod
    def of(
        cls,
        sources: Iterable[Source],
        targets: Sequence[Target],
        sensor: SensorModel | None,
        lidar: str | None = None,
        topic: str | None = None,
    ) -> Opened:
        """Open sources.

        Args:
            sources: sessions and recordings.
            targets: to look for; none: those that sessions name.
            sensor: the sensor's file; None: that of the first session.
            lidar: which LiDAR of the sessions; None: the only one.
            topic: of the scans of recordings; None: the only one.

        Raises:
            InputError: a source that can't be read; no sensor, or sensors that differ; a recording without targets; a
                LiDAR or a topic that is not there; a source given twice.
        """
        opened = [_opened(source) for source in sources]
        recordings = [one for one in opened if isinstance(one, Recording)]
        if not opened:
            raise InputError("nothing to calibrate: no session and no recording")
        shown = set[Path]()
        for one in opened:
            clouds = [view.scan for view in one.views if view.scan] if isinstance(one, Session) else []
            files = {path.resolve() for path in (one.path, *clouds) if path.exists()}
            if again := sorted(files & shown):
                raise InputError(f"{again[0]}: given twice; what it shows counts once")
            shown |= files
        if lidar is not None and len(recordings) == len(opened):
            raise InputError(f"LiDAR '{lidar}': only a session names LiDARs, and there is none")
        if topic is not None and not recordings:
            raise InputError(f"topic '{topic}': only a recording has topics, and there is none")
        chosen: list[Session | Recording] = []
        for one in opened:
            if isinstance(one, Session):
                one, sensor = _of_one_lidar(one, lidar, sensor)
            chosen.append(one)
        if sensor is None:
            raise InputError(f"{recordings[0].path}: a recording needs the sensor's file, or a built-in name")
        for recording in recordings:
            if not targets:
                raise InputError(f"{recording.path}: a recording needs the targets to look for")
            recording.topic("scan", topic)
        return cls(tuple(chosen), sensor, tuple(targets))

    def check(self, distances: Sequence[Distance], use_target_points: bool) -> None:
        """Raise if it is plain before the work that they can't be used.

        Args:
            distances: between boards.
            use_target_points: whether crops by hand are asked for.

        Raises:
            InputError: crops that are missing; distances between boards that are not there, or never seen at once; or
                motion capture of several boards.
            EstimationError: too few views for the fewest placements.
        """
        if use_target_points:
            self._check_crops()
        boards = {board.name: board for scene in self._scenes() for board in scene.values()}
        for distance in distances:
            _check_distance(distance, boards)
            a, b = distance.a[0], distance.b[0]
            if not any(a in scene and b in scene for scene in self._scenes()):
                raise InputError(f"distance between '{a}' and '{b}': no scan is said to show both at once")
            self._check_scan(distance.scan)
        captured = [one for one in self.sources if isinstance(one, Session) and one.mocap is not None]
        named = {name for session in captured for name in session.targets}
        if len(named) > 1:
            raise InputError(f"motion capture is used with one board; the sessions name {', '.join(sorted(named))}")
        most = sum(len(scene) for scene in self._scenes())
        if most < FEWEST and not any(isinstance(one, Recording) for one in self.sources):
            raise too_few(f"{most} are in view at most")

    def _check_crops(self) -> None:
        for one in self.sources:
            if isinstance(one, Recording):
                raise InputError(f"{one.path}: a recording has no 'target_points', which were asked for")
            for view in one.views:
                if view.scan is not None and view.target_points is None:
                    raise InputError(f"{view.where}: the view has no 'target_points', which were asked for")

    def _check_scan(self, name: str) -> None:
        sessions = [one for one in self.sources if isinstance(one, Session)]
        names = [relative_to(session, cloud) for session in sessions for cloud in scans_of(session)]
        if name and len(sessions) == len(self.sources) and name not in names:
            raise InputError(f"distance in scan '{name}': no scan is called that; found {', '.join(names[:3])}, ...")

    def _scenes(self) -> Iterator[Mapping[str, Target]]:
        """The boards that may stand in one scan, by their names: of each cloud, and of each recording."""
        given = {board.name: board for board in self.targets}
        for one in self.sources:
            if isinstance(one, Recording):
                yield given
                continue
            for numbers in scans_of(one).values():
                views = [one.views[number] for number in numbers]
                if not any(view.moving for view in views):
                    yield given or {name: one.targets[name] for view in views for name in view.targets}


def scans_of(session: Session) -> dict[Path, list[int]]:
    """Return the numbers of the views of each cloud of a session.

    Args:
        session: of one LiDAR.
    """
    scans: dict[Path, list[int]] = {}
    for number, view in enumerate(session.views):
        scans.setdefault(view.cloud, []).append(number)
    return scans


def too_few(found: str) -> EstimationError:
    """Return the error that placements are too few.

    Args:
        found: how many there are, in words.
    """
    return EstimationError(
        f"a sensor's calibration needs {FEWEST} placements of boards that stand still at least, better 20; {found}"
    )


def _opened(source: Source) -> Session | Recording:
    if isinstance(source, Session | Recording):
        return source
    return load_session(source) if Path(source).suffix.lower() in (".yaml", ".yml", ".json") else Recording(source)


def _of_one_lidar(session: Session, lidar: str | None, sensor: SensorModel | None) -> tuple[Session, SensorModel]:
    """Return the session of one of its LiDARs alone, targets called as it calls them, and that LiDAR's sensor.

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
    targets = {key: replace(target, name=key) for key, target in session.targets.items()}
    return replace(session, lidars={name: sensor}, views=views, targets=targets), sensor


def _check_distance(distance: Distance, boards: Mapping[str, Target]) -> None:
    """Raise if a distance is not between two of these boards, by name."""
    for name, vertex in (distance.a, distance.b):
        if name not in boards:
            raise InputError(f"distance to board '{name}': no board is called that; found {', '.join(sorted(boards))}")
        point_of(boards[name], vertex)
    if distance.a[0] == distance.b[0]:
        raise InputError(f"distance of '{distance.a[0]}' to itself: expected one between two boards")
