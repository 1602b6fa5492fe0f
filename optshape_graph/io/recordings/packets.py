"""Packets as a LiDAR sends them, captured (pcap) or recorded in a bag; velodyne-decoder and ouster-sdk decode them."""

from __future__ import annotations

import io
import itertools
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph.errors import InputError, MissingExtraError, missing_extra
from optshape_graph.io.clouds import Columns, make_scan
from optshape_graph.io.clouds.files import form_of_head
from optshape_graph.io.files import read_head
from optshape_graph.io.recordings.stream import BadMessage, Skipped, Stamped
from optshape_graph.io.recordings.topics import Topic
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel

VELODYNE = "velodyne_msgs/msg/VelodyneScan"

OUSTER = frozenset({"ouster_ros/msg/PacketMsg", "ouster_msgs/msg/PacketMsg", "ouster_sensor_msgs/msg/PacketMsg"})
"""Messages of an Ouster's packets, with returns or inertial data; they are decoded with the unit's metadata."""

DEFINITIONS = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    VELODYNE: "std_msgs/Header header\nVelodynePacket[] packets\n",
    **dict.fromkeys(OUSTER, "uint8[] buf\n"),
}
"""Messages of packets, as the drivers publish them (ros-drivers/velodyne, velodyne_msgs; ouster-lidar/ouster-ros)."""

PACKET_BYTES = 1206
"""Size of a Velodyne's packet of returns."""

LARGEST_PACKET = 262_144
"""Bytes that a captured packet has at most (libpcap's MAXIMUM_SNAPLEN)."""

SURVEYED = 500
"""So many packets at the beginning tell which LiDAR sends them."""


def is_capture(path: Path) -> bool:
    """Return whether a file is captured packets, pcap or pcapng, by its first bytes."""
    return path.is_file() and form_of_head(read_head(path, 64)) == "packets"


def metadata_beside(path: Path) -> Path | None:
    """Return the JSON file with an Ouster's metadata that lies beside a recording; None: there is none."""
    for file in [path.with_suffix(".json"), *sorted(path.parent.glob("*.json"))[:20]]:
        if file.is_file() and file.stat().st_size < 1 << 20 and b"beam_altitude_angles" in file.read_bytes():
            return file
    return None


class Capture:
    """A file of captured packets.

    Attributes:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def topics(self) -> tuple[Topic, ...]:
        """The one topic of scans.

        Raises:
            InputError: no packets of a LiDAR that is read here.
            MissingExtraError: the decoder is absent.
        """
        if self._metadata is not None:
            return (Topic("packets", "scan", "Ouster packets", None),)
        sizes: Counter[int] = Counter()
        for _, payload in itertools.islice(_payloads(self.path), SURVEYED):
            sizes[len(payload)] += 1
        if sizes[PACKET_BYTES]:
            return (Topic("packets", "scan", "Velodyne packets", None),)
        found = ", ".join(f"{count} of {size} bytes" for size, count in sizes.most_common(4)) or "none"
        raise InputError(
            f"{self.path}: packets ({found}) of no LiDAR that is read here: Velodyne's have {PACKET_BYTES} bytes; "
            f"an Ouster's need its metadata beside them ({self.path.with_suffix('.json').name}); others: export "
            "PCD or a bag with the maker's viewer"
        )

    @cached_property
    def _metadata(self) -> Path | None:
        """The file with an Ouster's metadata beside the capture."""
        return metadata_beside(self.path)

    def read(self, topic: Topic, skipped: Skipped, sensor: SensorModel | None = None) -> Iterator[Stamped[Any]]:
        """Yield the scans, one for each revolution.

        Raises:
            InputError: the file is damaged, or the packets do not tell the sensor's model.
            MissingExtraError: the decoder is absent.
        """
        scans = self._ouster() if topic.type.startswith("Ouster") else self._velodyne()
        for number, (stamp, columns) in enumerate(scans):
            try:
                yield Stamped(stamp, make_scan(columns, sensor))
            except InputError as error:
                skipped.add(BadMessage("not a scan", str(error)), f"{self.path} revolution {number}")

    def _velodyne(self) -> Iterator[tuple[float, Columns]]:
        decoder = _velodyne_decoder().StreamDecoder(_velodyne_decoder().Config())
        name = str(self.path)
        for stamp, payload in _payloads(self.path):
            if len(payload) == PACKET_BYTES:
                decoded = _decoded(name, partial(decoder.decode, stamp, payload, True))
                if decoded is not None:
                    yield float(decoded[0].host), _columns(decoded[1], name)
        decoded = _decoded(name, lambda: decoder.finish(True))
        if decoded is not None:
            yield float(decoded[0].host), _columns(decoded[1], name)

    def _ouster(self) -> Iterator[tuple[float, Columns]]:
        assert self._metadata is not None  # it is what made them an Ouster's
        yield from decode_ouster(
            self._metadata.read_text(encoding="utf-8"), (payload for _, payload in _payloads(self.path)), str(self.path)
        )


def decode_ouster(metadata: str, payloads: Iterable[bytes], name: str) -> Iterator[tuple[float, Columns]]:
    """Yield stamp, seconds, and points of each revolution in an Ouster's packets; the last may be incomplete.

    Args:
        metadata: of the unit, JSON as the sensor gives it.
        payloads: packets, which may include other kinds.
        name: of the clouds, for messages.

    Raises:
        InputError: metadata or packets that cannot be decoded.
        MissingExtraError: the decoder is absent.
    """
    core = _ouster_sdk()
    try:
        info = core.SensorInfo(metadata)
        form, batcher, frame = core.PacketFormat(info), core.FrameBatcher(info), core.LidarFrame(info)
        for payload in payloads:
            if not form.lidar_packet_size <= len(payload) <= form.lidar_packet_size + 1:  # old drivers send one more
                continue
            packet = core.LidarPacket(form)
            packet.buf[:] = np.frombuffer(payload, np.uint8, form.lidar_packet_size)
            if batcher.batch(packet, frame):
                yield ouster_columns(core, frame, name)
                frame = core.LidarFrame(info)
    except (InputError, GeneratorExit):
        raise
    except Exception as error:  # the decoder may raise anything
        raise InputError(f"{name}: Ouster packets that cannot be decoded: {error}") from error
    if np.asarray(frame.timestamp).any():
        yield ouster_columns(core, frame, name)


def ouster_columns(core: Any, frame: Any, name: str) -> tuple[float, Columns]:
    """Return the stamp, seconds, and the points of a decoded frame of an Ouster.

    Points are in the sensor's frame, rows from the uppermost beam down; each column of a frame has its own time.

    Args:
        core: the decoder's module.
        frame: what it decoded.
        name: of the cloud, for messages.
    """
    info = frame.sensor_info
    xyz = np.asarray(core.XYZLut(info, use_extrinsics=True)(frame), float)  # rows x columns x 3, as fired
    rows, columns = xyz.shape[:2]
    ns = np.asarray(frame.timestamp).astype(np.int64)
    seen = ns > 0
    first = int(ns[seen].min()) if seen.any() else 0
    values: dict[str, Any] = {
        "xyz": xyz.reshape(-1, 3),
        "ring": np.repeat(np.arange(rows), columns),
        "t": np.tile(ns - first, rows),
    }
    return first / 1e9, Columns(values, rows, name)


def decode_velodyne(message: Any, name: str, sensor: SensorModel | None) -> Stamped[Scan]:
    """Return the scan of a VelodyneScan, its points timed and placed by the decoder.

    Args:
        message: the deserialised message.
        name: of the cloud, for messages.
        sensor: the sensor that made it, if known.

    Raises:
        BadMessage: no packets, or packets that cannot be decoded.
    """
    library = _velodyne_decoder()
    if not len(message.packets):
        raise BadMessage("empty", "0 packets")
    packets = library.PacketVector()
    for packet in message.packets:
        stamp = packet.stamp.sec + packet.stamp.nanosec / 1e9
        packets.append(library.VelodynePacket(stamp, bytes(packet.data)))
    try:
        stamp, points = library.ScanDecoder(library.Config()).decode(packets, True)
        return Stamped(float(stamp.host), make_scan(_columns(points, name), sensor))
    except Exception as error:  # the decoder may raise anything; or no scan
        raise BadMessage("not a scan", str(error)) from error


def _columns(points: Any, name: str) -> Columns:
    return Columns({field: points[field] for field in points.dtype.names}, name=name)


def _decoded(name: str, decode: Any) -> Any:
    try:
        return decode()
    except Exception as error:  # the decoder may raise anything
        raise InputError(f"{name}: packets that cannot be decoded: {error}") from error


class _Packets(io.BufferedReader):
    """A capture that refuses to read more than a packet at once: a damaged length may state 4 GB."""

    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= LARGEST_PACKET:
            raise ValueError(f"a packet of {size} bytes; expected at most {LARGEST_PACKET}")
        return super().read(size)


def _payloads(path: Path) -> Iterator[tuple[float, bytes]]:
    """Yield stamp and payload of the UDP packets of a capture."""
    library = _velodyne_decoder()
    with _Packets(io.FileIO(path)) as stream:
        packets = iter(library.util.iter_pcap(stream, (None, None)))
        while True:
            try:
                stamp, payload = next(packets)
            except StopIteration:
                return
            except Exception as error:  # dpkt may raise anything on damaged bytes
                raise InputError(f"{path}: captured packets that are damaged: {error}") from error
            yield float(stamp), bytes(payload)


def _velodyne_decoder() -> Any:
    try:
        import velodyne_decoder
    except ImportError as cause:
        raise missing_extra("velodyne-decoder", "velodyne", cause) from cause
    return velodyne_decoder


def _ouster_sdk() -> Any:
    try:
        import ouster.sdk.core
    except ImportError as cause:
        raise MissingExtraError(
            f"ouster-sdk could not be imported ({cause}). pip cannot install the extras 'ros' and 'ouster' together "
            "(ouster-sdk asks for rosbags 0.9.23): install 'ros', then: pip install --no-deps ouster-sdk laspy"
        ) from cause
    return ouster.sdk.core
