"""A recording: topics of scans, images, camera parameters and poses, in files of any form."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from optshape_graph._arrays import Floats
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.recordings.bags import Bag, is_bag
from optshape_graph.io.recordings.folders import Folder
from optshape_graph.io.recordings.images import Image
from optshape_graph.io.recordings.packets import Capture, is_capture
from optshape_graph.io.recordings.stream import BadMessage, Skipped, Stamped, Stream
from optshape_graph.io.recordings.topics import Kind, Mounting, Topic, chained, choose, listed
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel

SURVEYED = 10
"""So many scans at the beginning tell whether a topic has rings."""


class Recording:
    """A ROS 1 or ROS 2 bag, an mcap file, captured packets, or a folder of clouds with timestamps.

    A topic need not be named if it is the only one of its kind. Streams read one message at a time while iterated.

    Attributes:
        path: what it was opened from.

    Raises:
        InputError: not a recording.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise InputError(f"{self.path}: no such file or folder")
        if is_bag(self.path):
            self._source: Bag | Folder | Capture = Bag(self.path)
        elif is_capture(self.path):
            self._source = Capture(self.path)
        elif self.path.is_dir():
            self._source = Folder(self.path)
        else:
            raise InputError(
                f"{self.path}: expected a .bag, .mcap, .db3 or .pcap file, a folder of a ROS 2 bag (with "
                "metadata.yaml), or a folder of clouds with timestamps.txt"
            )

    @property
    def topics(self) -> tuple[Topic, ...]:
        """All topics, including those that are not read."""
        return self._source.topics

    @property
    def span(self) -> tuple[float, float] | None:
        """Seconds of the first and the last message, as recorded; None: the recording does not say."""
        return self._source.span if isinstance(self._source, Bag) else None

    def mounting_frame(self, scan_topic: str | None = None) -> str:
        """Return the frame of a topic's scans; empty if the recording does not state it."""
        return self._source.frame(self.topic("scan", scan_topic)) if isinstance(self._source, Bag) else ""

    def static_transforms(self) -> dict[tuple[str, str], Floats]:
        """Return T_parent_child (4, 4) of static transforms, by names of parent and child; empty if there are none."""
        return self._source.static_transforms() if isinstance(self._source, Bag) else {}

    def topic(self, kind: Kind, name: str | None = None) -> Topic:
        """Return the topic of a kind and name, or the only one of a kind.

        Raises:
            InputError: none, or several; the message lists them.
        """
        return choose(self.topics, kind, name, self.path)

    def named(self, name: str) -> Topic:
        """Return the topic of a name.

        Raises:
            InputError: there is none.
        """
        for topic in self.topics:
            if topic.name == name:
                return topic
        raise InputError(f"{self.path}: no topic '{name}'; it has {listed(self.topics)}")

    def scans(self, topic: str | None = None, sensor: SensorModel | None = None) -> Stream[Scan]:
        """Return the scans of a topic.

        A scan without rings in a topic that has rings is skipped.

        Args:
            topic: its name; None: the only one.
            sensor: the sensor that made them.
        """
        chosen = self.topic("scan", topic)
        name = f"{self.path} {chosen.name}"
        return Stream(
            name,
            lambda skipped: _like_the_first(self._source.read(chosen, skipped, sensor), skipped, name),
            chosen.count,
        )

    def images(self, topic: str | None = None) -> Stream[Image]:
        """Return the images of a topic."""
        return self._stream(self.topic("image", topic))

    def poses(self, topic: str | None = None) -> Stream[Floats]:
        """Return the poses of a topic, (4, 4): of its moving frame in the frame that its header names."""
        return self._stream(self.topic("pose", topic))

    def mounting(self, scan_topic: str | None = None, pose_topic: str | None = None) -> Mounting:
        """Return where the LiDAR of a topic of scans sits on the body whose poses another topic has.

        Args:
            scan_topic: its name; None: the only one.
            pose_topic: its name; None: the only one.
        """
        if not isinstance(self._source, Bag):
            return Mounting("", "", None)
        lidar = self._source.frame(self.topic("scan", scan_topic))
        body = self._source.frame(self.topic("pose", pose_topic))
        return Mounting(body, lidar, chained(self._source.static_transforms(), body, lidar) if body and lidar else None)

    def cameras(self, topic: str | None = None) -> Stream[CameraIntrinsics]:
        """Return the camera parameters of a topic."""
        return self._stream(self.topic("camera", topic))

    def camera_of(self, image_topic: str) -> CameraIntrinsics:
        """Return the first intrinsics of the camera whose images are on a topic.

        They are on `camera_info` beside that topic, as camera drivers publish them, or on the only topic of their kind.

        Raises:
            InputError: no such topic, no usable message on it, or rectified images, to which published intrinsics do
                not apply.
        """
        if "/image_rect" in image_topic:
            raise InputError(f"{self.path}: images on {image_topic} are rectified; camera_info is of the raw ones")
        beside = {image_topic.rsplit("/", levels)[0] + "/camera_info" for levels in (1, 2)}
        name = next((topic.name for topic in self.topics if topic.kind == "camera" and topic.name in beside), None)
        stream = self.cameras(name)
        for camera in stream:
            return camera.value
        raise InputError(f"{stream.name}: no usable camera parameters; {stream.skipped}")

    def _stream(self, topic: Topic) -> Stream[Any]:
        return Stream(f"{self.path} {topic.name}", lambda skipped: self._source.read(topic, skipped), topic.count)


def _like_the_first(scans: Iterator[Stamped[Scan]], skipped: Skipped, where: str) -> Iterator[Stamped[Scan]]:
    """Yield scans; only those with rings, if any of the first `SURVEYED` has rings."""
    first = list(itertools.islice(scans, SURVEYED))
    rings = any(scan.value.ring is not None for scan in first)
    for scan in itertools.chain(first, scans):
        if rings and scan.value.ring is None:
            skipped.add(BadMessage("ring missing", f"at {scan.stamp:.9f} s"), where)
        else:
            yield scan
