"""ROS 1 bags, ROS 2 bags (sqlite3 and mcap) and bare storage files, read with rosbags; no ROS is needed."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError, missing_extra
from optshape_graph.io.clouds import make_scan
from optshape_graph.io.recordings import messages, packets
from optshape_graph.io.recordings.decompression import bounded_readers
from optshape_graph.io.recordings.stream import BadMessage, Skipped, Stamped
from optshape_graph.io.recordings.topics import Kind, Topic
from optshape_graph.sensor import SensorModel

SUFFIXES = (".bag", ".mcap", ".db3")
SURVEYED = 100
"""Number of tf messages in which transforms are looked for."""


def is_bag(path: Path) -> bool:
    """Return whether a path looks like a bag: a storage file, or a folder with the metadata of a ROS 2 bag."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix in SUFFIXES


class Bag:
    """A bag on disk. Every pass over its messages opens the file and closes it.

    Attributes:
        path: file, or folder of a ROS 2 bag.
        ros: 1 or 2: how messages are serialised.
        span: seconds of the first and the last message, as recorded; None: there are no messages.

    Raises:
        InputError: not a readable bag.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ros = 1 if path.suffix == ".bag" and path.is_file() else 2
        if path.is_dir():
            _check_inside(path)
        with self._open() as reader:
            self.span = (reader.start_time / 1e9, reader.end_time / 1e9) if reader.message_count else None
            self._recorded = tuple(
                Topic(name, _kind(name, info.msgtype or ""), info.msgtype or "of several types", info.msgcount)
                for name, info in reader.topics.items()
            )

    @cached_property
    def topics(self) -> tuple[Topic, ...]:
        """Topics as recorded, and the moving transforms found at the beginning of the tf topics.

        Raises:
            InputError: the bag cannot be read.
        """
        transforms = [
            Topic(f"{topic.name}:{parent}:{child}", "pose", topic.type, None)
            for topic in self._recorded
            if topic.type in messages.TRANSFORMS and not topic.name.endswith("tf_static")
            for parent, child in self._transforms(topic)
        ]
        return self._recorded + tuple(transforms)

    def read(self, topic: Topic, skipped: Skipped, sensor: SensorModel | None = None) -> Iterator[Stamped[Any]]:
        """Yield the values of a topic in order of recording: `Scan`, `Image`, `CameraIntrinsics` or a (4, 4) pose.

        Raises:
            InputError: the bag cannot be read.
        """
        if topic.type in packets.OUSTER:
            yield from self._ouster(topic, skipped, sensor)
            return
        if topic.type == messages.PATH:
            yield from self._latest_path(topic, skipped)
            return
        name = topic.name.rsplit(":", 2)[0] if topic.type in messages.TRANSFORMS else topic.name
        for number, (received, data) in enumerate(self._messages(name, skipped)):
            where = f"{self.path} {name} message {number}"
            try:
                values = self._decode(topic, data, where, sensor, skipped.unused)
            except BadMessage as problem:
                skipped.add(problem, where)
                continue
            yield from (replace(value, received=received) for value in values)

    def _ouster(self, topic: Topic, skipped: Skipped, sensor: SensorModel | None) -> Iterator[Stamped[Any]]:
        """Yield the scans in an Ouster's packets, decoded with the metadata recorded beside them."""
        name = f"{self.path} {topic.name}"
        metadata = self._ouster_metadata()
        if metadata is None:
            raise InputError(
                f"{name}: an Ouster's packets, and no metadata: expected a topic of it, or its JSON file beside the bag"
            )
        payloads = (
            bytes(messages.read_message(self.ros, topic.type, data).buf) for data in self._raw(topic.name, skipped)
        )
        for number, (stamp, columns) in enumerate(packets.decode_ouster(metadata, payloads, name)):
            try:
                yield Stamped(stamp, make_scan(columns, sensor))
            except InputError as error:
                skipped.add(BadMessage("not a scan", str(error)), f"{name} revolution {number}")

    def _ouster_metadata(self) -> str | None:
        for topic in self._recorded:
            if topic.type == "std_msgs/msg/String" and "metadata" in topic.name:
                with closing(self._raw(topic.name, Skipped())) as raw:
                    for data in raw:
                        return str(messages.read_message(self.ros, topic.type, data).data)
        file = packets.metadata_beside(self.path)
        return None if file is None else file.read_text(encoding="utf-8")

    def _latest_path(self, topic: Topic, skipped: Skipped) -> Iterator[Stamped[Floats]]:
        """Yield the poses of the last path: each path repeats the one before, and adds a pose."""
        latest: list[Stamped[Floats]] = []
        for number, data in enumerate(self._raw(topic.name, skipped)):
            try:
                latest = messages.decode_path(self.ros, data)
            except BadMessage as problem:
                skipped.add(problem, f"{self.path} {topic.name} message {number}")
        yield from latest

    def _decode(
        self, topic: Topic, data: bytes, where: str, sensor: SensorModel | None, unused: Counter[str]
    ) -> list[Stamped[Any]]:
        if topic.kind == "scan":
            return [messages.decode_scan(self.ros, topic.type, data, where, sensor, unused)]
        if topic.kind == "image":
            return [messages.decode_image(self.ros, topic.type, data)]
        if topic.kind == "camera":
            return [messages.decode_camera(self.ros, topic.type, data)]
        if topic.type in messages.TRANSFORMS:
            _, parent, child = topic.name.rsplit(":", 2)
            return list(messages.decode_transform(self.ros, topic.type, data, parent, child))
        return [messages.decode_pose(self.ros, topic.type, data)]

    def frame(self, topic: Topic) -> str:
        """Return the frame of a topic's scans, or the frame whose poses a topic has; empty if it is not stated.

        Raises:
            InputError: the bag cannot be read.
        """
        if topic.type in messages.TRANSFORMS:
            return topic.name.rsplit(":", 1)[1]
        with closing(self._raw(topic.name, Skipped())) as raw:
            for data in itertools.islice(raw, SURVEYED):
                try:
                    return messages.frame_of(messages.read_message(self.ros, topic.type, data), topic.kind)
                except BadMessage:
                    continue
        return ""

    def static_transforms(self) -> dict[tuple[str, str], Floats]:
        """Return T_parent_child (4, 4), by names of parent and child, of all static transforms.

        Raises:
            InputError: the bag cannot be read.
        """
        found: dict[tuple[str, str], Floats] = {}
        for topic in self._recorded:
            if topic.type in messages.TRANSFORMS and topic.name.endswith("tf_static"):
                with closing(self._raw(topic.name, Skipped())) as raw:
                    for data in raw:
                        try:
                            found |= messages.transforms_in(messages.read_message(self.ros, topic.type, data))
                        except BadMessage:
                            continue
        return found

    def _transforms(self, topic: Topic) -> list[tuple[str, str]]:
        found: dict[tuple[str, str], None] = {}
        with closing(self._raw(topic.name, Skipped())) as raw:
            for data in itertools.islice(raw, SURVEYED):
                try:
                    message = messages.read_message(self.ros, topic.type, data)
                except BadMessage:
                    continue
                found.update((messages.frames_of(transform), None) for transform in message.transforms)
        return list(found)

    def _raw(self, name: str, skipped: Skipped) -> Generator[bytes, None, None]:
        """Yield the serialised messages of a topic in order of recording."""
        with closing(self._messages(name, skipped)) as both:
            yield from (data for _, data in both)

    def _messages(self, name: str, skipped: Skipped) -> Generator[tuple[float, bytes], None, None]:
        """Yield when the messages of a topic were received, seconds, and they, serialised, in order of recording.

        Reading ends where the file is damaged; the remaining messages in its index are counted as skipped.
        """
        with self._open() as reader:
            connections = [connection for connection in reader.connections if connection.topic == name]
            for connection in connections:
                if connection.msgdef.format.name == "MSG" and connection.msgdef.data:
                    where = f"{self.path} {name}"
                    messages.check_definition(self.ros, connection.msgtype, connection.msgdef.data, where)
            promised = sum(connection.msgcount for connection in connections)
            raw = reader.messages(connections)
            for number in itertools.count():
                try:
                    _, received, data = next(raw)
                except StopIteration:
                    return
                except Exception as error:  # a storage reader may raise anything on damaged bytes
                    problem = BadMessage("recording damaged from there on", f"{type(error).__name__}: {error}")
                    skipped.add(problem, f"{self.path} {name} message {number}", max(promised - number, 1))
                    return
                yield 1e-9 * received, data

    @contextmanager
    def _open(self) -> Iterator[Any]:
        try:
            Reader1, Reader2 = bounded_readers()
        except ImportError as cause:
            raise missing_extra("rosbags", "ros", cause) from cause
        try:
            reader: Any = Reader1(self.path) if self.ros == 1 else Reader2(self.path)
            reader.open()
        except (PermissionError, FileNotFoundError):
            raise
        except Exception as error:  # a storage reader may raise anything on damaged bytes
            raise InputError(
                f"{self.path}: not a readable bag: {error or type(error).__name__}"
                " (a recording that was cut off needs `rosbag reindex`, `ros2 bag reindex` or `mcap recover`)"
            ) from error
        try:
            yield reader
        finally:
            reader.close()


def _kind(name: str, msgtype: str) -> Kind:
    """Return the kind of a topic, by its type; by its name for an Ouster's packets, which are all of one type."""
    return "other" if msgtype in packets.OUSTER and "imu" in name else messages.kind_of(msgtype)


def _check_inside(folder: Path) -> None:
    """Check that no file in a bag's folder is a link that leads out of it: such links may be copied with the bag.

    Raises:
        InputError: a file is such a link.
    """
    for path in folder.iterdir():
        if not path.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{path}: leads out of the bag's folder, to {path.resolve()}; give that path instead")
