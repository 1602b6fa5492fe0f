"""Bags for the tests, written with rosbags' own writers: messages, layouts of drivers, storages."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph.io.recordings.messages import type_store

STORAGES = ("ros1", "sqlite3", "mcap", "db3", "bare")
"""ROS 1; ROS 2 folders with sqlite3 and mcap; the storage files of such folders on their own."""

DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

XYZ = {"x": ("<f4", 0), "y": ("<f4", 4), "z": ("<f4", 8)}


def layout(fields: dict[str, tuple[str, int]], itemsize: int) -> np.dtype[Any]:
    return np.dtype({
        "names": list(fields),
        "formats": [kind for kind, _ in fields.values()],
        "offsets": [offset for _, offset in fields.values()],
        "itemsize": itemsize,
    })  # fmt: skip


LAYOUTS = {
    "velodyne": layout(XYZ | {"intensity": ("<f4", 12), "ring": ("<u2", 16), "time": ("<f4", 18)}, 22),
    "ouster": layout(XYZ | {"intensity": ("<f4", 16), "t": ("<u4", 20), "reflectivity": ("<u2", 24),
                            "ring": ("u1", 26), "ambient": ("<u2", 28), "range": ("<u4", 32)}, 48),
    "hesai": layout(XYZ | {"intensity": ("<f4", 16), "timestamp": ("<f8", 24), "ring": ("<u2", 32)}, 48),
    "robosense": layout(XYZ | {"intensity": ("<f4", 12), "ring": ("<u2", 16), "timestamp": ("<f8", 18)}, 26),
    "livox": layout(XYZ | {"intensity": ("<f4", 12), "tag": ("u1", 16), "line": ("u1", 17),
                           "timestamp": ("<f8", 18)}, 26),
}  # fmt: skip
"""As the drivers' sources have them, padding included."""


class Maker:
    """Makes messages of ROS 1 or ROS 2."""

    def __init__(self, ros: int) -> None:
        self.ros = ros
        self.store = type_store(ros)
        self._sequence = 0

    def __getitem__(self, name: str) -> Any:
        return self.store.types[name]

    def header(self, stamp: float, frame: str = "lidar") -> Any:
        ns = round(stamp * 1e9)
        time = self["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
        if self.ros == 2:
            return self["std_msgs/msg/Header"](time, frame)
        self._sequence += 1
        return self["std_msgs/msg/Header"](self._sequence, time, frame)

    def cloud(self, stamp: float, points: NDArray[Any], height: int = 1, row_padding: int = 0) -> Any:
        """A PointCloud2 of a structured array, in its byte order; rows may be padded."""
        rows = points.reshape(height, -1)
        big = any(points.dtype[name].str.startswith(">") for name in points.dtype.names)
        fields = [
            self["sensor_msgs/msg/PointField"](name, offset, DATATYPES[kind.str.lstrip("<>|")], 1)
            for name, (kind, offset) in points.dtype.fields.items()
        ]
        step = points.dtype.itemsize
        row_step = rows.shape[1] * step + row_padding
        data = b"".join(row.tobytes() + bytes(row_padding) for row in rows)
        return self["sensor_msgs/msg/PointCloud2"](
            self.header(stamp), height, rows.shape[1], fields, big, step, row_step, np.frombuffer(data, np.uint8), True
        )

    def livox(self, stamp: float, points: NDArray[Any], package: str = "livox_ros_driver2") -> Any:
        made = self[f"{package}/msg/CustomPoint"]
        items = [made(*(p[name].item() for name in ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")))
                 for p in points]  # fmt: skip
        reserved = np.zeros(3, np.uint8)
        return self[f"{package}/msg/CustomMsg"](self.header(stamp), round(stamp * 1e9), len(items), 1, reserved, items)

    def _pose(self, T: NDArray[np.float64]) -> tuple[Any, Any]:
        from scipy.spatial.transform import Rotation

        quaternion = self["geometry_msgs/msg/Quaternion"](*map(float, Rotation.from_matrix(T[:3, :3]).as_quat()))
        return T[:3, 3], quaternion

    def odometry(self, stamp: float, T: NDArray[np.float64]) -> Any:
        t, q = self._pose(T)
        vector, zero = self["geometry_msgs/msg/Vector3"], np.zeros(36)
        pose = self["geometry_msgs/msg/Pose"](self["geometry_msgs/msg/Point"](*map(float, t)), q)
        twist = self["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        return self["nav_msgs/msg/Odometry"](
            self.header(stamp, "odom"), "base",
            self["geometry_msgs/msg/PoseWithCovariance"](pose, zero),
            self["geometry_msgs/msg/TwistWithCovariance"](twist, zero),
        )  # fmt: skip

    def pose_stamped(self, stamp: float, T: NDArray[np.float64]) -> Any:
        odometry = self.odometry(stamp, T)
        return self["geometry_msgs/msg/PoseStamped"](odometry.header, odometry.pose.pose)

    def transform(self, stamp: float, T: NDArray[np.float64], parent: str, child: str) -> Any:
        t, q = self._pose(T)
        moved = self["geometry_msgs/msg/Transform"](self["geometry_msgs/msg/Vector3"](*map(float, t)), q)
        return self["geometry_msgs/msg/TransformStamped"](self.header(stamp, parent), child, moved)

    def tf(self, *transforms: Any) -> Any:
        return self["tf2_msgs/msg/TFMessage"](list(transforms))

    def image(self, stamp: float, rows: NDArray[np.uint8], encoding: str, padding: int = 0) -> Any:
        height, width = rows.shape[:2]
        flat = rows.reshape(height, -1)
        padded = np.pad(flat, ((0, 0), (0, padding)))
        return self["sensor_msgs/msg/Image"](
            self.header(stamp), height, width, encoding, 0, padded.shape[1], padded.ravel()
        )

    def compressed(self, stamp: float, data: bytes, form: str = "jpeg") -> Any:
        return self["sensor_msgs/msg/CompressedImage"](self.header(stamp), form, np.frombuffer(data, np.uint8))

    def camera_info(self, stamp: float, K: NDArray[np.float64], D: NDArray[np.float64], model: str) -> Any:
        roi = self["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        return self["sensor_msgs/msg/CameraInfo"](
            self.header(stamp), 480, 640, model, D, K.ravel(), np.eye(3).ravel(), np.zeros(12), 0, 0, roi
        )

    def serialize(self, message: Any) -> bytes:
        name = message.__msgtype__
        raw = self.store.serialize_ros1(message, name) if self.ros == 1 else self.store.serialize_cdr(message, name)
        return bytes(raw)


def maker(storage: str) -> Maker:
    return Maker(1 if storage == "ros1" else 2)


def write_bag(
    folder: Path,
    storage: str,
    items: Iterable[tuple[str, Any]],
    types: dict[str, str] | None = None,
    step: float = 0.01,
) -> Path:
    """Write messages, or serialised bytes of the type that `types` gives their topic, in order; return the bag's path.

    The time of recording counts from 5000 s in steps: it never equals a header's stamp.
    """
    make = maker(storage)
    if storage == "ros1":
        from rosbags.rosbag1 import Writer as Writer1

        path = folder / "recording.bag"
        writer: Any = Writer1(path)
    else:
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2

        path = folder / "recording"
        plugin = StoragePlugin.SQLITE3 if storage in ("sqlite3", "db3") else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=plugin)
    connections: dict[str, Any] = {}
    with writer:
        for number, (topic, message) in enumerate(items):
            name = (types or {}).get(topic) or message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=make.store)
            data = message if isinstance(message, bytes) else make.serialize(message)
            writer.write(connections[topic], 5000 * 10**9 + round(number * step * 1e9), data)
    return {"db3": path / "recording.db3", "bare": path / "recording.mcap"}.get(storage, path)


def points(name: str, n: int = 40, stamp: float = 100.0, seed: int = 0) -> NDArray[Any]:
    """Returns of a small sensor with four beams, in the layout of a driver, with everything it would say of them."""
    rng = np.random.default_rng(seed)
    made = np.zeros(n, LAYOUTS[name])
    beam = np.arange(n) % 4
    elevation = np.radians([-6.0, -2.0, 2.0, 6.0])[beam]
    azimuth = np.linspace(-1, 1, n)
    distance = rng.uniform(2, 20, n)
    made["x"] = distance * np.cos(elevation) * np.cos(azimuth)
    made["y"] = distance * np.cos(elevation) * np.sin(azimuth)
    made["z"] = distance * np.sin(elevation)
    made["intensity"] = rng.integers(0, 256, n)
    if "ring" in made.dtype.names:
        made["ring"] = 3 - beam if name in ("ouster", "hesai") else beam
    else:
        made["line"] = beam
    since = np.linspace(0, 0.099, n)
    if name == "velodyne":
        made["time"] = since
    elif name == "ouster":
        made["t"] = np.round(since * 1e9)
    elif name == "livox":
        made["timestamp"] = (stamp + since) * 1e9
    else:
        made["timestamp"] = stamp + since
    return made
