"""A session's scans and markers, brought together for a motion-capture calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.mocap.comparison import MIN_MARKERS, MocapScan, assign_markers
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.clouds import read_scan
from optshape_graph.io.sessions import Mocap, Session
from optshape_graph.pose import estimate_pose
from optshape_graph.target import Target


@dataclass(frozen=True)
class LeftOut:
    """A scan of the session that takes no part.

    Attributes:
        scan: its file, as the session names it.
        reason: why.
    """

    scan: str
    reason: str


def load_mocap_scans(
    session: Session, progress: Callable[[int, int], None] = lambda done, total: None
) -> tuple[tuple[MocapScan, ...], tuple[LeftOut, ...]]:
    """Read and estimate every scan of a session that has markers.

    Args:
        session: with motion capture, of one LiDAR and one target; each scan holds the target's returns.
        progress: called with the number of scans done and their total.

    Returns:
        The scans that can be used, and those that cannot, with reasons: no marker frame, too few markers, an estimate
        that failed or is ambiguous.

    Raises:
        InputError: no motion capture; several LiDARs or targets; markers that cannot be assigned; a cloud that
            cannot be read.
    """
    if session.mocap is None:
        raise InputError(f"{session.path}: the session has no motion capture ('mocap')")
    for kind, names in (("LiDAR", session.lidars), ("target", session.targets)):
        if len(names) != 1:
            raise InputError(f"{session.path}: a motion-capture calibration is of one {kind}; found {len(names)}")
    target = next(iter(session.targets.values()))
    of_vertex = _markers_of_vertices(session.mocap, target, session.path)
    used: list[MocapScan] = []
    left_out: list[LeftOut] = []
    for done, view in enumerate(session.views):
        progress(done, len(session.views))
        name = str(view.scan.relative_to(session.path.parent) if view.scan.is_relative_to(session.path.parent)
                   else view.scan)  # fmt: skip
        if view.mocap_frame is None:
            left_out.append(LeftOut(name, "the session gives it no mocap_frame"))
            continue
        frame = session.mocap.markers.frames[view.mocap_frame]
        markers = np.array([frame[marker] if marker else np.full(3, np.nan) for marker in of_vertex])
        seen = int(np.isfinite(markers).all(axis=1).sum())
        if seen < MIN_MARKERS:
            left_out.append(LeftOut(name, f"frame {view.mocap_frame} shows {seen} markers; {MIN_MARKERS} are needed"))
            continue
        scan = replace(read_scan(view.target_points or view.scan, session.lidars[view.lidar]), name=name)
        try:
            estimate = estimate_pose(scan, target)
        except EstimationError as error:
            left_out.append(LeftOut(name, str(error)))
            continue
        if estimate.status != "ok":
            left_out.append(LeftOut(name, f"{estimate.status}: {estimate.reason}"))
            continue
        used.append(MocapScan(name, estimate, markers))
    progress(len(session.views), len(session.views))
    return tuple(used), tuple(left_out)


def _markers_of_vertices(mocap: Mocap, target: Target, path: Path) -> list[str]:
    """For each vertex the name of the marker near it, "" where there is none."""
    if mocap.vertices:
        names = [""] * len(target)
        for marker, (_, vertex) in mocap.vertices.items():
            names[vertex] = marker
        return names
    order = list(mocap.markers.names)
    frames: list[Floats] = [np.array([frame[name] for name in order]) for frame in mocap.markers.frames.values()]
    try:
        return [order[k] for k in assign_markers(target, frames)]
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
