"""Livox's CustomMsg: header, a time base, and points packed one after the other.

The message is parsed here, since rosbags would make an object of every point. The layout is that published with
livox_ros_driver, livox_ros_driver2 and livox_interfaces (they agree):

    std_msgs/Header header; uint64 timebase; uint32 point_num; uint8 lidar_id; uint8[3] rsvd; CustomPoint[] points
    CustomPoint: uint32 offset_time; float32 x, y, z; uint8 reflectivity, tag, line
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph.io.clouds.columns import Columns
from optshape_graph.io.recordings.stream import BadMessage

TYPES = frozenset(
    f"{package}/msg/CustomMsg" for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
)

DEFINITIONS = {
    "CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points\n",
    "CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n",
}
"""The layout as message definitions, which a bag must state for these types."""

_POINT = [
    ("offset_time", "u4"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"),
]  # fmt: skip


def livox_columns(data: bytes, cdr: bool, name: str) -> tuple[float, Columns]:
    """Return the stamp, seconds, and the points of a serialised CustomMsg.

    `offset_time` is returned in nanoseconds since the header's stamp; the message counts from its time base, which the
    driver sets to the stamp or near it. `line` is the laser, of a pattern without rings; `tag` is the sensor's rating
    of a return.

    Args:
        data: the serialised message.
        cdr: serialised for ROS 2 (CDR, members aligned) instead of ROS 1 (packed).
        name: of the cloud, for messages.

    Raises:
        BadMessage: shorter or longer than it declares, or no points.
    """
    try:
        stamp, values = _parse(memoryview(data), cdr)
    except (struct.error, IndexError, ValueError) as error:
        raise BadMessage("truncated", f"{len(data)} bytes: {error}") from None
    return stamp, Columns(values, 1, name)


def _parse(data: memoryview, cdr: bool) -> tuple[float, dict[str, NDArray[Any]]]:
    if cdr:
        order, stride, origin = ("<" if data[1] == 1 else ">"), 20, 4
        sec, nsec, length = struct.unpack_from(order + "iII", data, origin)
        at = origin + 12 + length
        at += (origin - at) % 8  # CDR aligns from the end of its own 4-byte header
    else:
        order, stride = "<", 19
        sec, nsec, length = struct.unpack_from("<4xIII", data, 0)
        at = 16 + length
    timebase, _, count = struct.unpack_from(order + "QI4xI", data, at)
    if count == 0:
        raise BadMessage("empty", "0 points")
    point = np.dtype({
        "names": [name for name, _ in _POINT],
        "formats": [order + kind for _, kind in _POINT],
        "offsets": [0, 4, 8, 12, 16, 17, 18],
        "itemsize": stride,
    })  # fmt: skip
    body = data[at + 20 :]
    if len(body) < (count - 1) * stride + 19:
        raise BadMessage("truncated", f"{len(body)} bytes of points, {count} points declared")
    points = np.ndarray((count,), point, body[: (count - 1) * stride + 19].tobytes().ljust(count * stride, b"\0"))
    stamp_ns = sec * 10**9 + nsec
    fields = {name: points[name] for name in ("x", "y", "z")}
    fields |= {"intensity": points["reflectivity"], "tag": points["tag"], "line": points["line"]}
    # A time base of another clock (uptime of the sensor) says nothing about the stamp: then the stamp is the start.
    lead_ns = timebase - stamp_ns if abs(timebase - stamp_ns) < 10**9 else 0
    fields["offset_time"] = points["offset_time"].astype(np.int64) + lead_ns
    return stamp_ns / 10**9, fields
