"""A session's scans and markers, brought together for a motion-capture calibration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.mocap.comparison import MIN_MARKERS, MocapScan, assign_markers
from optshape_graph.calibration.mocap.graph import MarkerModel
from optshape_graph.calibration.mocap.layout import CheckedMarkers, check_markers
from optshape_graph.calibration.mocap.result import LeftOut
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.clouds import read_scan
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.sessions import Mocap, Session, View
from optshape_graph.pose import PoseEstimate, estimate_poses
from optshape_graph.runs.files import fingerprint
from optshape_graph.runs.kept import Kept
from optshape_graph.scan import Scan
from optshape_graph.target import Target


def load_mocap_scans(
    session: Session,
    layout_prior: float = MarkerModel.layout_prior,
    progress: Callable[[int, int], None] = lambda done, total: None,
    passed_over: PassedOver | None = None,
    kept: Kept | None = None,
) -> tuple[tuple[MocapScan, ...], tuple[LeftOut, ...], CheckedMarkers]:
    """Read and estimate every scan of a session that has markers, the markers checked and mended first.

    Args:
        session: with motion capture, of one LiDAR and one target; each scan holds the target's returns.
        layout_prior: standard deviation of a marker's place about its vertex along each axis, metres.
        progress: called with the number of scans done and their total.
        passed_over: counts the scans that cannot be used, the clouds' fields and the markers that are not used.
        kept: estimates of a run that was stopped, and of this one; None: they are not kept.

    Returns:
        The scans that can be used; those that cannot, with reasons: no marker frame, too few markers, an estimate
        that failed or is ambiguous; and the checked markers.

    Raises:
        InputError: no motion capture; several LiDARs or targets; markers that cannot be assigned, or in another unit
            of length; a cloud that cannot be read.
    """
    if session.mocap is None:
        raise InputError(f"{session.path}: the session has no motion capture ('mocap')")
    for kind, found in (("LiDAR", session.lidars), ("target", session.targets)):
        if len(found) != 1:
            raise InputError(f"{session.path}: a motion-capture calibration is of one {kind}; found {len(found)}")
    target = next(iter(session.targets.values()))
    names = markers_of_vertices(session.mocap, target, session.path)
    wanted = dict.fromkeys(view.mocap_frame for view in session.views if view.mocap_frame is not None)
    frames = {number: of_vertices(session.mocap.markers.frames[number], names) for number in wanted}
    checked = check_markers(target, frames, names, layout_prior, str(session.path))
    passed_over = PassedOver() if passed_over is None else passed_over
    for reason, count in session.mocap.markers.passed_over.items():
        passed_over.skip("markers", reason, count)
    results: dict[int, MocapScan | LeftOut] = {}
    views, kept = session.views, kept or Kept()

    def leave_out(number: int, name: str, kind: str, reason: str) -> None:
        passed_over.skip("scans", kind)
        results[number] = LeftOut(name, reason)

    for first in range(0, len(views), AT_ONCE):
        seen: dict[int, Scan] = {}
        for number, view in enumerate(views[first : first + AT_ONCE], start=first):
            progress(number, len(views))
            folder = session.path.parent
            name = str(view.cloud.relative_to(folder) if view.cloud.is_relative_to(folder) else view.cloud)
            if objection := _objection(view, checked):
                leave_out(number, name, *objection)
                continue
            path = view.target_points or view.cloud
            returns = read_scan(path, session.lidars[view.lidar], unused=passed_over.unused("scans"))
            seen[number] = replace(returns, name=name)
        for (number, returns), estimate in zip(seen.items(), _estimates(seen, session, target, kept), strict=True):
            if isinstance(estimate, EstimationError):
                leave_out(number, returns.name, "no pose found", str(estimate))
            elif estimate.status in ("failed", "ambiguous"):  # a doubtful one is judged by the other scans
                leave_out(number, returns.name, "no pose found", f"{estimate.status}: {estimate.reason}")
            else:
                frame = views[number].mocap_frame
                assert frame is not None  # or there was an objection
                results[number] = MocapScan(returns.name, estimate, checked.frames[frame], frame, returns)
    progress(len(views), len(views))
    in_order = [one for _, one in sorted(results.items(), key=lambda item: item[0])]
    used = tuple(one for one in in_order if isinstance(one, MocapScan))
    return used, tuple(one for one in in_order if isinstance(one, LeftOut)), checked


AT_ONCE = 16
"""Scans whose poses are estimated at once."""


def _objection(view: View, checked: CheckedMarkers) -> tuple[str, str] | None:
    """Return why a view's markers cannot be used, in a word or two and in full; None where they can."""
    frame = view.mocap_frame
    if frame is None:
        return "no marker frame", "the session gives it no mocap_frame"
    if frame in checked.left_out:
        return "markers that contradict the target", checked.left_out[frame]
    seen = int(np.isfinite(checked.frames[frame]).all(axis=1).sum())
    if seen < MIN_MARKERS:
        return "too few markers", f"frame {frame} shows {seen} markers; {MIN_MARKERS} are needed"
    return None


def _estimates(
    seen: Mapping[int, Scan], session: Session, target: Target, kept: Kept
) -> list[PoseEstimate | EstimationError]:
    """Estimate the poses of a target in the scans of views, by their numbers, all at once."""
    steps = [
        {
            "scan": fingerprint([str(view.target_points or view.cloud)]), "name": returns.name,
            "sensor": session.lidars[view.lidar], "target": target,
        }
        for view, returns in ((session.views[number], returns) for number, returns in seen.items())
    ]  # fmt: skip
    return kept.together(PoseEstimate, steps, lambda: estimate_poses(list(seen.values()), target))


def of_vertices(frame: Mapping[str, Floats], names: Sequence[str]) -> Floats:
    """Return the positions (n, 3), metres, of the markers with these names, NaN where a name is empty.

    Args:
        frame: positions (3,) of markers, metres, by name.
        names: of the markers.
    """
    return np.array([frame[name] if name else np.full(3, np.nan) for name in names])


def markers_of_vertices(mocap: Mocap, target: Target, path: Path) -> list[str]:
    """Return for each vertex the name of the marker near it, "" where there is none.

    Raises:
        InputError: the session does not say, and the markers' distances do not tell.
    """
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
