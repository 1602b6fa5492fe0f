"""A session cut out of a recording: scans with the images and marker frames of the same moment."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats, Value
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.documents import write_json
from optshape_graph.io.mocap import MocapRecording
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.recordings.clocks import ClockOffset, estimate_clock_offset, marker_rotations
from optshape_graph.io.recordings.recording import Recording
from optshape_graph.io.recordings.sessionfiles import (
    Track,
    View,
    write_images,
    write_markers,
    write_scans,
    write_session,
)
from optshape_graph.io.recordings.stream import ROUNDING, Stream, pair, spaced
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

FEWEST_MARKERS = 3
"""A frame locates a target if so many markers are seen."""


@dataclass(frozen=True)
class Selection:
    """Which scans become views.

    Attributes:
        tolerance: largest difference between a scan's stamp and its image's, seconds.
        start, end: seconds since the recording's first scan.
        interval: views are at least this far apart, seconds.
    """

    tolerance: float = 0.05
    start: float = 0.0
    end: float = np.inf
    interval: float = 0.0


@dataclass(frozen=True, eq=False, repr=False)
class Extraction(Value):
    """The outcome of an extraction.

    Attributes:
        session: the session file written.
        scans: number of usable scans between start and end.
        views: number of views written.
        thinned: number of complete scans that were left out to keep the interval.
        dropped: number of scans dropped by reason.
        skipped: number of messages skipped by stream and reason.
        unused: number of messages that had a field which is not used, by stream and field.
        lags: (V,) image stamp minus scan stamp, seconds, corrected for the clocks; empty without images.
    """

    session: Path
    scans: int
    views: int
    thinned: int
    dropped: Mapping[str, int]
    skipped: Mapping[str, Mapping[str, int]]
    unused: Mapping[str, Mapping[str, int]]
    lags: Floats

    @property
    def passed_over(self) -> PassedOver:
        """Messages and fields of the streams that were not used."""
        of = [{f"messages of {name}": Counter(n) for name, n in by.items()} for by in (self.skipped, self.unused)]
        return PassedOver(*of)


def estimate_mocap_offset(
    recording: Recording, mocap: MocapRecording, topic: str | None = None, track: Track = lambda items, *_: items
) -> ClockOffset:
    """Estimate what to add to motion-capture times to get the recording's stamps, from the turning of the sensor.

    Args:
        recording: with odometry or other poses of the sensor, or of what it is fixed to.
        mocap: of markers fixed to the same body.
        topic: of the poses; None: the only one.
        track: shows progress.

    Raises:
        UnobservableError: the sensor hardly turned, or the motion does not tell the offset.
        InputError: no such topic, or no three markers on one body.
    """
    stream = recording.poses(topic)
    poses = list(track(stream, f"reading {stream.name}", stream.expected))
    if len(poses) < 3:
        raise InputError(f"{stream.name}: {len(poses)} poses do not show a motion; {stream.skipped}")
    rotations = Rotation.from_matrix(np.array([pose.value[:3, :3] for pose in poses]))
    return estimate_clock_offset(np.array([pose.stamp for pose in poses]), rotations, *marker_rotations(mocap))


def extract_session(
    recording: Recording,
    folder: Path,
    *,
    sensor: SensorModel,
    targets: Sequence[Target],
    scan_topic: str | None = None,
    image_topic: str | None = None,
    camera: CameraIntrinsics | None = None,
    camera_offset: float = 0.0,
    mocap: MocapRecording | None = None,
    mocap_offset: float = 0.0,
    selection: Selection = Selection(),
    track: Track = lambda items, *_: items,
) -> Extraction:
    """Write a session of the scans for which everything asked for was recorded.

    The recording is read twice, once to pair and once to write, so that only stamps are kept in memory. A scan belongs
    to the image nearest in time, if it is that image's nearest scan; markers are interpolated between their frames at
    the scan's stamp.

    Args:
        recording: to cut from.
        folder: to write to; it must not hold a session yet.
        sensor: the LiDAR.
        targets: those that may be in view.
        scan_topic: of the scans; None: the only one.
        image_topic: of the images; needs `camera`. None: the only one.
        camera: the intrinsics; None: no images.
        camera_offset: what to add to the stamps of images to get the LiDAR's clock, seconds.
        mocap: the markers on the targets; None: none.
        mocap_offset: what to add to motion-capture times to get the LiDAR's clock, seconds.
        selection: which scans.
        track: shows progress.

    Raises:
        InputError: nothing could be paired, or the folder has a session.
    """
    session = folder / "session.yaml"
    if session.exists():
        raise InputError(f"{session}: there is a session already; name another folder")
    scans = recording.scans(scan_topic, sensor)
    images = None if camera is None else recording.images(image_topic)
    stamps = _stamps(scans, track)
    if not len(stamps):
        raise InputError(f"{scans.name}: no usable scan; {scans.skipped}")
    since = stamps - stamps[0]
    stamps = stamps[(since >= selection.start - ROUNDING) & (since <= selection.end + ROUNDING)]
    skipped = {scans.name: dict(scans.skipped)}
    unused = {scans.name: dict(scans.skipped.unused)}
    dropped: Counter[str] = Counter()
    complete = np.ones(len(stamps), dtype=bool)

    image_stamps, paired = np.zeros(0), np.full(len(stamps), -1)
    if images is not None:
        image_stamps = _stamps(images, track)
        skipped[images.name] = dict(images.skipped)
        paired = pair(stamps, image_stamps + camera_offset, selection.tolerance)
        dropped[f"no image within {selection.tolerance:g} s"] = int((paired < 0).sum())
        complete &= paired >= 0
    positions = np.zeros((len(stamps), 0, 3))
    if mocap is not None:
        skipped[mocap.name] = dict(mocap.passed_over)
        positions = mocap.at(stamps - mocap_offset)
        seen = np.isfinite(positions[:, :, 0]).sum(axis=1) >= FEWEST_MARKERS
        dropped[f"fewer than {FEWEST_MARKERS} markers"] = int((complete & ~seen).sum())
        complete &= seen
    chosen = np.flatnonzero(complete)
    kept = chosen[spaced(stamps[chosen], selection.interval)]
    views = {int(k): View(number, float(stamps[k])) for number, k in enumerate(kept)}

    if images is not None:
        wanted = {float(image_stamps[paired[k]]): view for k, view in views.items()}
        broken = write_images(images, wanted, folder, track)
        dropped["undecodable image"] = len(broken)
        views = {k: view for k, view in views.items() if view.number not in broken}
    if not views:
        clocks = {
            "scans": stamps,
            "images": image_stamps + camera_offset,
            "markers": np.zeros(0) if mocap is None else mocap.times + mocap_offset,
        }
        raise InputError(_nothing_paired(recording, dropped, clocks, images))
    if mocap is not None:
        write_markers(folder / "markers.csv", mocap.markers, {v.number: positions[k] for k, v in views.items()})
    write_scans(scans, {view.stamp: view for view in views.values()}, folder, mocap is not None, track)
    extraction = Extraction(
        session,
        len(stamps),
        len(views),
        len(chosen) - len(kept),
        {reason: count for reason, count in dropped.items() if count},
        skipped,
        unused,
        np.array([image_stamps[paired[k]] + camera_offset - stamps[k] for k in views if images is not None]),
    )
    write_json(folder / "extract.json", _report(recording, extraction, selection, camera_offset, mocap_offset))
    write_session(session, recording.path.stem, sensor, targets, camera, mocap is not None, list(views.values()))
    return extraction


def _stamps(stream: Stream[Any], track: Track) -> Floats:
    return np.array([item.stamp for item in track(stream, f"pairing {stream.name}", stream.expected)])


def _nothing_paired(
    recording: Recording, dropped: Mapping[str, int], clocks: Mapping[str, Floats], images: Stream[Any] | None
) -> str:
    if images is not None and not len(clocks["images"]):
        return f"{images.name}: no usable image: {images.skipped}"
    reasons = ", ".join(f"{count} x {reason}" for reason, count in dropped.items() if count) or "no scan in that time"
    spans = "; ".join(f"{name} from {t[0]:.3f} to {t[-1]:.3f} s" for name, t in clocks.items() if len(t))
    return f"{recording.path}: nothing could be paired: {reasons} ({spans}: is a clock offset needed?)"


def _report(
    recording: Recording, extraction: Extraction, selection: Selection, camera_offset: float, mocap_offset: float
) -> dict[str, Any]:
    return {
        "schema": "optshape/extract/1",
        "recording": str(recording.path),
        "selection": {
            "tolerance_s": selection.tolerance,
            "start_s": selection.start,
            "end_s": None if np.isinf(selection.end) else selection.end,
            "interval_s": selection.interval,
        },
        "clock_offsets_s": {"camera": camera_offset, "mocap": mocap_offset},
        "scans": extraction.scans,
        "views": extraction.views,
        "thinned": extraction.thinned,
        "dropped": dict(extraction.dropped),
        "skipped": {name: dict(reasons) for name, reasons in extraction.skipped.items()},
        "unused_fields": {name: dict(fields) for name, fields in extraction.unused.items() if fields},
        "image_lags_s": extraction.lags.tolist(),
    }
