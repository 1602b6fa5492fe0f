"""What is mapped, opened: scans of one or several LiDARs, where each of them is on the robot, and odometry."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import merge
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.io.clouds import read_scan
from optshape_graph.io.documents import read_plain
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.recordings import Recording, Skipped, Stamped, Stream
from optshape_graph.io.recordings.stream import BadMessage, Jump
from optshape_graph.io.recordings.topics import Mounting, chained
from optshape_graph.io.sessions import Session, load_session
from optshape_graph.io.trajectories import Trajectory, is_trajectory, read_trajectory
from optshape_graph.scan import Scan
from optshape_graph.se3 import PoseLike, as_transform, inverse
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

BODY = "body"
"""What a file of extrinsics may call the frame that the odometry is of, where the recording has no name for it."""

Transforms = Mapping[tuple[str, str], Floats]
"""T_a_b (4, 4), by the names of frames a and b."""


@dataclass(frozen=True, eq=False)
class Lidar:
    """One LiDAR of a robot.

    Attributes:
        name: its topic, or its name in a session; empty: there is only one.
        scans: in order of time.
        T_first_lidar: (4, 4) of it in the frame of the first LiDAR, which is that of the robot's poses.
    """

    name: str
    scans: Iterable[Stamped[Scan]]
    T_first_lidar: Floats = field(default_factory=lambda: np.eye(4))


@dataclass(eq=False)
class Source:
    """What is mapped.

    Attributes:
        name: of the session.
        lidars: the first one's frame is the robot's.
        expected: number of scans that the source says there are, or None.
        targets: to look for.
        poses: T_odometry_body (N, 4, 4) over time; None: there is no odometry.
        T_body_lidar: (4, 4) of the first LiDAR on the body that the poses are of; None: not known.
        mounting: the same as the recording has it; None: it was given, or there is no odometry.
        warnings: what was taken for granted, in words.
        missed: files of a session that could not be used.
    """

    name: str
    lidars: Sequence[Lidar]
    expected: int | None
    targets: Sequence[Target]
    poses: Iterable[Stamped[Floats]] | None = None
    T_body_lidar: Floats | None = None
    mounting: Mounting | None = None
    warnings: list[str] = field(default_factory=list)
    missed: Skipped = field(default_factory=Skipped)

    @property
    def skipped(self) -> Skipped:
        """Messages of scans that could not be used, by reason, as far as they have been read."""
        total = Skipped()
        for found in (self.missed, *(stream.skipped for stream in self._streams)):
            total.update(found)
            total.unused.update(found.unused)
            total.examples = found.examples | total.examples
        return total

    @property
    def jumps(self) -> dict[str, tuple[Jump, ...]]:
        """How clocks were set, by the name of the stream."""
        streams = [*self._streams, *([self.poses] if isinstance(self.poses, Stream) else [])]
        return {stream.name: tuple(stream.jumps) for stream in streams if stream.jumps}

    def passed_over(self, skipped: Mapping[str, int]) -> PassedOver:
        """Return what was not used, with scans that were skipped for other reasons."""
        found = PassedOver({"scans": Counter(skipped) + self.skipped}, {"scans": self.skipped.unused})
        if isinstance(self.poses, Stream):
            found.skipped[f"messages of {self.poses.name}"] = Counter(self.poses.skipped)
        return found

    @property
    def _streams(self) -> list[Stream[Scan]]:
        return [lidar.scans for lidar in self.lidars if isinstance(lidar.scans, Stream)]


def in_turn(lidars: Sequence[Lidar]) -> Iterator[tuple[Lidar, Stamped[Scan]]]:
    """Yield the scans of all LiDARs in order of time."""

    def of(lidar: Lidar) -> Iterator[tuple[Lidar, Stamped[Scan]]]:
        return ((lidar, scan) for scan in lidar.scans)

    return merge(*map(of, lidars), key=lambda item: item[1].stamp)


def open_source(
    recording: str | Path | Recording | Session,
    targets: Sequence[Target],
    sensor: SensorModel | Mapping[str, SensorModel] | None,
    scans: str | Sequence[str] | None,
    odometry: str | Path | Trajectory | None,
    mounting: PoseLike | Mapping[str, PoseLike] | None,
    extrinsics: Transforms | None,
) -> Source:
    """Open a recording or a session, with its odometry; see `map_recording`.

    Raises:
        InputError: no such recording, topic or file, no targets, or a LiDAR of several whose place is not known.
    """
    if isinstance(recording, str | Path) and Path(recording).suffix.lower() in (".yaml", ".yml", ".json"):
        recording = load_session(recording)
    if isinstance(odometry, str | Path) and is_trajectory(odometry):
        odometry = read_trajectory(odometry)
    poses: Iterable[Stamped[Floats]] | None = _stamped(odometry) if isinstance(odometry, Trajectory) else None
    if isinstance(recording, Session):
        if targets or sensor or scans:
            raise InputError(f"{recording.path}: a session names its own targets, sensor and scans")
        if odometry not in (None, "none") and poses is None:
            raise InputError(f"{recording.path}: a session has no topic '{odometry}'; odometry comes from a file")
        return _of_session(recording, poses, mounting, extrinsics or {})
    if not targets:
        raise InputError("no targets: what is to be looked for in the recording")
    opened = recording if isinstance(recording, Recording) else Recording(recording)
    names = [scans] if isinstance(scans, str) or scans is None else list(scans)
    topics = [opened.topic("scan", name).name for name in names]
    if len(set(topics)) < len(topics):
        raise InputError(f"{opened.path}: a topic of scans is named twice: {', '.join(topics)}")
    sensors = sensor if isinstance(sensor, Mapping) else dict.fromkeys(topics, sensor)
    streams = [opened.scans(topic, sensors.get(topic)).following() for topic in topics]
    topic = odometry if isinstance(odometry, str) and odometry != "none" else None
    found = None
    if poses is None and odometry != "none" and (topic or any(t.kind == "pose" for t in opened.topics)):
        poses = opened.poses(topic).following()
        found = opened.mounting(topics[0], topic)
    frames = {name: opened.mounting_frame(name) for name in topics}
    known = {**opened.static_transforms(), **(extrinsics or {})}
    known |= {(frame, name): np.eye(4) for name, frame in frames.items() if frame}
    if found is not None and found.body:
        known[found.body, BODY] = np.eye(4)
    given = _given(mounting, topics)
    lidars = [
        Lidar("" if len(topics) == 1 else name, stream, T)
        for name, stream, T in zip(topics, streams, _in_first(topics, given, known, str(opened.path)), strict=True)
    ]
    counts = [stream.expected for stream in streams]
    source = Source(opened.path.stem, lidars, None if None in counts else sum(filter(None, counts)), targets, poses)
    if poses is None:
        return source
    source.T_body_lidar = given.get(topics[0], chained(known, BODY, topics[0]))
    if topics[0] not in given and not extrinsics:
        source.mounting = found
    if source.T_body_lidar is None and found is not None and found.body and found.lidar:
        source.warnings.append(
            f"odometry is of '{found.body}', scans are in '{found.lidar}', and no static transform links them: "
            "taken for one frame; --mounting says where the LiDAR is"
        )
    return source


def _of_session(
    session: Session,
    poses: Iterable[Stamped[Floats]] | None,
    mounting: PoseLike | Mapping[str, PoseLike] | None,
    extrinsics: Transforms,
) -> Source:
    used, missed = {view.lidar for view in session.views}, Skipped()
    names = [name for name in session.lidars if name in used]
    given = _given(mounting, names)
    lidars = [
        Lidar("" if len(names) == 1 else name, session_scans(session, missed, name), T)
        for name, T in zip(names, _in_first(names, given, extrinsics, str(session.path)), strict=True)
    ]
    return Source(
        session.path.stem, lidars, len(session.views), list(session.targets.values()), poses,
        given.get(names[0], chained(extrinsics, BODY, names[0])), missed=missed,
    )  # fmt: skip


def _given(mounting: PoseLike | Mapping[str, PoseLike] | None, names: Sequence[str]) -> dict[str, Floats]:
    """Where LiDARs are on the body, as was said: by name, or of the first one."""
    if mounting is None:
        return {}
    said = mounting if isinstance(mounting, Mapping) else {names[0]: mounting}
    for name in said:
        if name not in names:
            raise InputError(f"mounting of '{name}': the LiDARs are {', '.join(names)}")
    return {name: as_transform(T, f"mounting of '{name}'") for name, T in said.items()}


def _in_first(names: Sequence[str], given: Mapping[str, Floats], known: Transforms, where: str) -> list[Floats]:
    """T_first_lidar (4, 4) of each LiDAR, by what was said of them and by transforms that are known.

    Raises:
        InputError: of one it is not known.
    """
    known = {**known, **{(BODY, name): T for name, T in given.items()}}
    found = [np.eye(4)]
    for name in names[1:]:
        if names[0] in given and name in given:
            T: Floats | None = inverse(given[names[0]]) @ given[name]
        else:
            T = chained(known, names[0], name)
        if T is None:
            raise InputError(
                f"{where}: where '{name}' is relative to '{names[0]}' is not known: no transform links them; "
                "--mounting of each, or --extrinsics, says it"
            )
        found.append(as_transform(T, f"pose of '{name}' in '{names[0]}'"))
    return found


def read_extrinsics(path: str | Path) -> dict[tuple[str, str], Floats]:
    """Read T_a_b (4, 4), by the names of frames a and b, from a document with `transforms`, such as a calibrated rig.

    `transforms` is a list of `{a: ..., b: ..., T_a_b: 4 x 4}`; other keys are not looked at. A frame is called by the
    topic of its LiDAR, by its name in a session, or by the frame in the messages' headers; the body that odometry is
    of by that too, or `body`.

    Raises:
        InputError: not readable, or not of that form; the message names file and key.
    """
    root = read_plain(path)
    if not isinstance(root.value, dict) or "transforms" not in root.value:
        root.expected("a mapping with 'transforms', a list of {a, b, T_a_b}")
    found: dict[tuple[str, str], Floats] = {}
    for node in root.at("transforms").items():
        fields = node.fields(("a", "b", "T_a_b"))
        try:
            T = as_transform(fields["T_a_b"].numbers(4, 4), "T_a_b")
        except InputError as error:
            node.fail(str(error))
        found[fields["a"].text(), fields["b"].text()] = T
    return found


def session_scans(session: Session, skipped: Skipped, lidar: str | None = None) -> Iterator[Stamped[Scan]]:
    """Yield a session's scans by their stamps; without stamps, a second apart in the file's order.

    A file that cannot be read is skipped and counted.

    Args:
        session: of one LiDAR, or
        skipped: to count in.
        lidar: of that one's scans.

    Raises:
        InputError: stamps of some views only, or several LiDARs without stamps.
    """
    stamped = [view for view in session.views if view.stamp is not None]
    if stamped and len(stamped) < len(session.views):
        raise InputError(
            f"{session.path}: {len(stamped)} of {len(session.views)} views have a stamp; expected all or none"
        )
    if len({view.lidar for view in session.views}) > 1 and not stamped:
        raise InputError(f"{session.path}: views of several LiDARs need stamps: {', '.join(session.lidars)}")
    views = sorted((v for v in session.views if lidar in (None, v.lidar)), key=lambda view: view.stamp or 0.0)
    last = -np.inf
    for k, view in enumerate(views):
        stamp = float(k) if view.stamp is None else view.stamp
        if stamp <= last:
            skipped.add(BadMessage("stamp duplicated", f"{stamp} s"), str(view.cloud))
            continue
        try:
            scan = read_scan(view.cloud, session.lidars[view.lidar], unused=skipped.unused)
        except InputError as error:
            skipped.add(BadMessage("unreadable file", str(error)), str(view.cloud))
            continue
        last = stamp
        yield Stamped(stamp, scan)


def _stamped(trajectory: Trajectory) -> list[Stamped[Floats]]:
    if trajectory.stamps is None:
        raise InputError(f"{trajectory.name}: odometry needs stamps")
    return [Stamped(float(stamp), T) for stamp, T in zip(trajectory.stamps, trajectory.poses, strict=True)]
