"""A session's files to sightings: what LiDARs, cameras and motion capture show of the targets, and when."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.scans import ScanKey, ScanResult, relative_to
from optshape_graph.calibration.camera.session import (
    ImageKey,
    ImageResult,
    Progress,
    moments_of,
    read_files,
    scan_file,
)
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.mocap.comparison import MIN_MARKERS, align
from optshape_graph.calibration.mocap.session import markers_of_vertices
from optshape_graph.calibration.rig.points import Marked
from optshape_graph.calibration.rig.sightings import Seen, Sighting, TargetInMarkers
from optshape_graph.errors import InputError
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.sessions import Mocap, Session, View, sensors_of
from optshape_graph.runs.kept import Kept
from optshape_graph.target import Target

MARKER_SIGMA = 1e-3
"""Standard deviation of a marker coordinate, metres."""


@dataclass(frozen=True, eq=False, repr=False)
class Read(Value):
    """What a session shows.

    Attributes:
        sightings: in the order of the views.
        problems: of what could not be read or shows no target: its sensor, its file, and why.
        sensors: names of all sensors, LiDARs first, then cameras, then motion capture.
        unusable: what is wrong with the files that cannot be read.
    """

    sightings: tuple[Sighting, ...]
    problems: tuple[tuple[str, str, str], ...]
    sensors: tuple[str, ...]
    unusable: tuple[str, ...] = ()


def read_sightings(
    session: Session,
    use_target_points: bool = False,
    progress: Progress | None = None,
    passed_over: PassedOver | None = None,
    kept: Kept | None = None,
) -> Read:
    """Find the session's targets in what its sensors took.

    Args:
        session: of at least two sensors.
        use_target_points: whether to take the targets' returns from the views' manual crops.
        progress: called as images and scans are done.
        passed_over: counts the scans and images that show nothing, and the clouds' fields that are not used.
        kept: what a run that was stopped found, and this one finds; None: it is not kept.

    Raises:
        InputError: fewer than two sensors; a view that is moving without a stamp; markers of no target; crops that
            were asked for are missing; intrinsics that fit half of the images or fewer; a moving view's cloud without
            times.
        EstimationError: no image, though there are some, shows a target.
    """
    sensors = (*session.lidars, *session.cameras, *sensors_of(session.mocap))
    if len(sensors) < 2:
        raise InputError(
            f"{session.path}: a rig is of two sensors at least; the session names {', '.join(sensors)} alone"
        )
    for view in session.views:
        if view.moving and view.stamp is None:
            raise InputError(f"{view.where}: a view that is 'moving' needs a 'stamp', seconds on its sensor's clock")
    vertices = _vertices(session)
    scans, images = read_files(session, use_target_points, progress, passed_over, kept)
    moments = moments_of(session.views)
    sightings: dict[Hashable, Sighting] = {}
    problems: dict[tuple[str, str], Exception] = {}
    for number, view in enumerate(session.views):
        for name in view.targets:
            target = replace(session.targets[name], name=name)
            seen = _seen(session, view, target, scans, images, vertices, use_target_points)
            for key, sensor, file, found in seen:
                if isinstance(found, Exception):
                    problems.setdefault((sensor, file), found)
                elif key not in sightings:  # a scan that several views name is one
                    placement = name if name in session.static else f"{name}@{moments[number]}"
                    sighting = Sighting(sensor, target, moments[number], placement, found, file, view.stamp)
                    sightings[key] = _of_moving(sighting, view, len(sightings)) if view.moving else sighting
    unusable = tuple(str(why) for why in problems.values() if isinstance(why, InputError))
    return Read(
        tuple(sightings.values()), tuple((*where, str(why)) for where, why in problems.items()), sensors, unusable
    )


def _of_moving(sighting: Sighting, view: View, number: int) -> Sighting:
    """A sighting of what moves: at a time of its own, and so in a place of its own.

    Raises:
        InputError: the view's cloud has no times.
    """
    assert view.stamp is not None  # or the session was refused
    time = view.stamp
    if isinstance(sighting.seen, TargetInScan):
        if sighting.seen.own.time is None:
            raise InputError(
                f"{view.where}: {sighting.file}: returns have no times; what moves is seen at each one's own"
            )
        time += float(sighting.seen.own.time.mean())
    return replace(sighting, placement=f"{sighting.target.name}~{number}", time=time, moving=True)


def _seen(
    session: Session,
    view: View,
    target: Target,
    scans: Mapping[ScanKey, ScanResult],
    images: Mapping[ImageKey, ImageResult],
    vertices: Mapping[str, Mapping[str, int]],
    use_target_points: bool,
) -> list[tuple[Hashable, str, str, Seen | Exception]]:
    """What the sensors of a view show of a target: what makes it one sighting, the sensor, the file, and what."""
    found, name = list[tuple[Hashable, str, str, Seen | Exception]](), target.name
    if view.scan is not None:
        key = (scan_file(view, use_target_points), view.lidar, name)
        found.append((key, view.lidar, relative_to(session, view.scan), scans[key]))
    if view.image is not None and view.camera is not None:
        in_image = (view.image, view.camera, name)
        found.append((in_image, view.camera, relative_to(session, view.image), images[in_image]))
    if view.mocap_frame is not None and session.mocap is not None:
        for sensor in sensors_of(session.mocap):
            in_markers = _in_markers(session.mocap, sensor, view.mocap_frame, target, vertices.get(name, {}))
            if in_markers is not None:
                file = f"frame {view.mocap_frame} of the markers"
                found.append(((view.mocap_frame, sensor, name), sensor, file, in_markers))
    return found


def _vertices(session: Session) -> dict[str, dict[str, int]]:
    """Of each target, the markers that are near its vertices, with the vertices' numbers."""
    if session.mocap is None:
        return {}
    found: dict[str, dict[str, int]] = {}
    for marker, (name, vertex) in session.mocap.vertices.items():
        found.setdefault(name, {})[marker] = vertex
    if not found and len(session.targets) == 1 and not session.mocap.bodies:
        ((name, target),) = session.targets.items()
        names = markers_of_vertices(session.mocap, target, session.path)
        found[name] = {marker: vertex for vertex, marker in enumerate(names) if marker}
    if not found:
        raise InputError(
            f"{session.path}: mocap: markers that belong to no target; expected the map 'markers' of each to its "
            "target and vertex"
        )
    return found


def _in_markers(
    mocap: Mocap, sensor: str, frame: int, target: Target, vertices: Mapping[str, int]
) -> TargetInMarkers | None:
    """A target's markers as a body sees them, or motion capture itself; None where too few are seen."""
    seen = mocap.markers.frames[frame]
    names = [name for name in vertices if name in seen and np.isfinite(seen[name]).all()]
    if len(names) < MIN_MARKERS:
        return None
    points, of_body = np.array([seen[name] for name in names]), np.zeros((6, 6))
    if sensor in mocap.bodies:
        body = {name: p for name, p in mocap.bodies[sensor].items() if name in seen and np.isfinite(seen[name]).all()}
        if len(body) < MIN_MARKERS:
            return None
        places = np.array(list(body.values()))
        T_body_mocap = align(places, np.array([seen[name] for name in body]))
        points = points @ T_body_mocap[:3, :3].T + T_body_mocap[:3, 3]
        of_body = _of_body(places)
    numbers = np.array([vertices[name] for name in names])
    near = target.vertices[numbers]
    T_sensor_target = align(points, near)
    covariance = _of_pose(Marked.of(points, near, numbers, MARKER_SIGMA, of_body), T_sensor_target, len(target))
    return TargetInMarkers(points, numbers, MARKER_SIGMA, T_sensor_target, covariance, of_body)


def _of_body(places: Floats) -> Floats:
    """Covariance (6, 6) of a body's pose by its markers (k, 3): of the right perturbation, rotation first."""
    marked = Marked(places, places, np.arange(len(places)), np.eye(3 * len(places)) / MARKER_SIGMA)
    return _of_pose(marked, np.eye(4), len(places))


def _of_pose(marked: Marked, T: Floats, n: int) -> Floats:
    by_pose = marked.whitened(T, np.zeros(3 * n))[1]
    return np.asarray(np.linalg.inv(by_pose.T @ by_pose))
