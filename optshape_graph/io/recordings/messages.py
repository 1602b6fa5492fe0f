"""Stamped values of ROS messages, by message type.

The types are the standard ones, compiled from definitions that ship with rosbags and from those below. The
definitions embedded in a bag are compared with them and never compiled: reading a bag runs no code of the bag.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError, missing_extra
from optshape_graph.io.clouds import make_scan
from optshape_graph.io.recordings import images, livox, packets
from optshape_graph.io.recordings.pointcloud2 import point_columns
from optshape_graph.io.recordings.stream import BadMessage, Stamped
from optshape_graph.io.recordings.topics import Kind
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel

CLOUD = "sensor_msgs/msg/PointCloud2"
SCANS = livox.TYPES | {CLOUD, packets.VELODYNE}
TRANSFORMS = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
PATH = "nav_msgs/msg/Path"
POSES = frozenset({
    "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
})  # fmt: skip
IMAGES = frozenset({"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"})
CAMERAS = frozenset({"sensor_msgs/msg/CameraInfo"})

SAME_CLOCK = 10.0
"""Times of points further than this from the scan's stamp, seconds, come from another clock."""


@cache
def type_store(ros: int) -> Any:
    """Return the message types of ROS 1 or ROS 2 that recordings are read with."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as cause:
        raise missing_extra("rosbags", "ros", cause) from cause
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for name in TRANSFORMS - store.fielddefs.keys():
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", name))
    for name in livox.TYPES:
        package = name.removesuffix("CustomMsg")
        store.register({
            **get_types_from_msg(livox.DEFINITIONS["CustomPoint"], package + "CustomPoint"),
            **get_types_from_msg(livox.DEFINITIONS["CustomMsg"], name),
        })  # fmt: skip
    for name, definition in packets.DEFINITIONS.items():
        store.register(get_types_from_msg(definition, name))
    return store


def check_definition(ros: int, msgtype: str, definition: str, where: str) -> None:
    """Check that a definition embedded in a recording is the standard one.

    Raises:
        InputError: it has other members, so that its messages would be misread.
    """
    from rosbags.typesys import TypesysError, get_types_from_msg

    known = type_store(ros).fielddefs
    try:
        embedded = get_types_from_msg(definition, msgtype)
    except (TypesysError, RecursionError) as error:
        raise InputError(f"{where}: its definition of {msgtype} cannot be parsed: {error}") from error
    for name, (_, members) in embedded.items():
        if name in known and members != known[name][1]:
            ours = ", ".join(member for member, _ in known[name][1])
            theirs = ", ".join(member for member, _ in members)
            raise InputError(f"{where}: its {name} has members {theirs}; the standard one has {ours}")


def read_message(ros: int, msgtype: str, data: bytes) -> Any:
    """Deserialise one message.

    Raises:
        BadMessage: shorter or longer than its type, or otherwise not such a message.
    """
    store = type_store(ros)
    try:
        return store.deserialize_ros1(data, msgtype) if ros == 1 else store.deserialize_cdr(data, msgtype)
    except Exception as error:  # a generated parser may raise anything on arbitrary bytes
        raise BadMessage("truncated or malformed", f"{len(data)} bytes: {error}") from error


def decode_scan(
    ros: int, msgtype: str, data: bytes, name: str, sensor: SensorModel | None, unused: Counter[str] | None = None
) -> Stamped[Scan]:
    """Return the scan of a PointCloud2, a Livox CustomMsg, or a Velodyne's packets.

    The layouts of drivers differ in what they call ring and time, and in type, unit and direction of both:
    Velodyne `ring`, `time` (float32, s since the stamp); Ouster `ring` from the top, `t` (uint32, ns since the
    stamp), organised; Hesai `ring`, `timestamp` (float64, epoch s); RoboSense the same; Livox no ring, `timestamp`
    (float64, epoch ns) or `offset_time` (uint32, ns). `make_scan` tells them apart. Times of another clock than
    the stamp's count from the first point. `unused` counts fields, by name, that do not go into the scan.
    """
    if msgtype in livox.TYPES:
        stamp, columns = livox.livox_columns(data, ros == 2, name)
    elif msgtype == packets.VELODYNE:
        return packets.decode_velodyne(read_message(ros, msgtype, data), name, sensor)
    else:
        message = read_message(ros, msgtype, data)
        stamp, columns = stamp_of(message), point_columns(message, name)
    x, y, z = (columns.values[axis] for axis in "xyz")
    if not (np.isfinite(x) & np.isfinite(y) & np.isfinite(z) & ((x != 0) | (y != 0) | (z != 0))).any():
        raise BadMessage("no returns", f"{len(x)} points, all at the origin or not finite")
    try:
        with np.errstate(invalid="ignore", over="ignore"):  # damaged bytes are any number, signalling NaN among them
            scan = make_scan(columns, sensor, stamp, unused)
    except InputError as error:
        raise BadMessage("not a scan", str(error)) from error
    if scan.time is not None and abs(np.median(scan.time)) > SAME_CLOCK:
        scan = replace(scan, time=scan.time - scan.time.min())
    return Stamped(stamp, scan)


def decode_image(ros: int, msgtype: str, data: bytes) -> Stamped[images.Image]:
    """Return the image of an Image or a CompressedImage."""
    message = read_message(ros, msgtype, data)
    raw = msgtype == "sensor_msgs/msg/Image"
    return Stamped(stamp_of(message), images.raw_image(message) if raw else images.compressed_image(message))


def decode_camera(ros: int, msgtype: str, data: bytes) -> Stamped[CameraIntrinsics]:
    """Return the intrinsics of a CameraInfo, named after its frame."""
    message = read_message(ros, msgtype, data)
    return Stamped(stamp_of(message), images.camera_intrinsics(message, message.header.frame_id or "camera"))


def decode_pose(ros: int, msgtype: str, data: bytes) -> Stamped[Floats]:
    """Return the pose of an Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped: (4, 4).

    It maps points of the moving frame into the frame that the header names.
    """
    message = read_message(ros, msgtype, data)
    if msgtype == "geometry_msgs/msg/TransformStamped":
        return _transform(message)
    pose = message.pose if msgtype == "geometry_msgs/msg/PoseStamped" else message.pose.pose
    return Stamped(stamp_of(message), rigid(pose.position, pose.orientation))


def decode_path(ros: int, data: bytes) -> list[Stamped[Floats]]:
    """Return the poses (4, 4) of a Path, each with its own stamp, in order of time; one pose for each stamp.

    Raises:
        BadMessage: no poses, or poses without stamps: a plan, not a trajectory.
    """
    message = read_message(ros, PATH, data)
    poses = {stamp_of(pose): rigid(pose.pose.position, pose.pose.orientation) for pose in message.poses}
    if not poses:
        raise BadMessage("empty", "a path without poses")
    if len(poses) == 1 and len(message.poses) > 1:
        raise BadMessage("path without stamps", f"{len(message.poses)} poses of one stamp")
    return [Stamped(stamp, poses[stamp]) for stamp in sorted(poses)]


def decode_transform(ros: int, msgtype: str, data: bytes, parent: str, child: str) -> Iterator[Stamped[Floats]]:
    """Yield T_parent_child of every such transform in a TFMessage: (4, 4)."""
    for transform in read_message(ros, msgtype, data).transforms:
        if frames_of(transform) == (parent, child):
            yield _transform(transform)


def frames_of(transform: Any) -> tuple[str, str]:
    """Return parent and child frame of a TransformStamped, without the leading slash that old tf wrote."""
    return transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/")


def frame_of(message: Any, kind: Kind) -> str:
    """Return the frame of a scan, or the frame whose pose a message has; empty if it is not stated."""
    frame = message.header.frame_id if kind == "scan" else getattr(message, "child_frame_id", "")
    return str(frame).lstrip("/")


def transforms_in(message: Any) -> dict[tuple[str, str], Floats]:
    """Return T_parent_child (4, 4) of a TFMessage, by names of parent and child."""
    return {frames_of(transform): _transform(transform).value for transform in message.transforms}


def stamp_of(message: Any) -> float:
    """Return a message's header stamp, seconds."""
    stamp = message.header.stamp
    return float((stamp.sec * 10**9 + stamp.nanosec) / 10**9)


def rigid(translation: Any, quaternion: Any) -> Floats:
    """Return the (4, 4) transform of a geometry_msgs translation and quaternion.

    Raises:
        BadMessage: not finite, or a quaternion whose norm is not 1 within 1 %.
    """
    from scipy.spatial.transform import Rotation

    t = np.array([translation.x, translation.y, translation.z])
    q = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])
    if not (np.isfinite(t).all() and np.isfinite(q).all()):
        raise BadMessage("pose not finite", f"translation {t.tolist()}, quaternion {q.tolist()}")
    if np.abs(q).max() > 2 or abs(np.linalg.norm(q) - 1) > 0.01:  # the square of a damaged number overflows
        raise BadMessage("quaternion not of unit norm", f"{q.tolist()}")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(q).as_matrix()
    T[:3, 3] = t
    return T


def _transform(message: Any) -> Stamped[Floats]:
    return Stamped(stamp_of(message), rigid(message.transform.translation, message.transform.rotation))


TYPES: dict[Kind, frozenset[str]] = {
    "scan": SCANS | packets.OUSTER,
    "image": IMAGES,
    "camera": CAMERAS,
    "pose": POSES | {PATH},
}
"""Message types by the kind of topic."""


def kind_of(msgtype: str) -> Kind:
    """Return what kind of topic has messages of a type."""
    return next((kind for kind, types in TYPES.items() if msgtype in types), "other")
