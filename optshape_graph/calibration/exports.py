"""Where sensors are, in the forms that other programs read: Kalibr, URDF, ROS 1 and 2, Autoware."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats, Value
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.documents import write_yaml
from optshape_graph.io.files import write_atomically
from optshape_graph.names import markup, shell_word
from optshape_graph.se3 import inverse

OPTICAL_OF_LINK = np.array([[0.0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""T_optical_link: a camera's link has x forward, y left, z up; its optical frame z forward, x right, y down."""


@dataclass(frozen=True, eq=False, repr=False)
class Mounted(Value):
    """A sensor on a platform.

    Attributes:
        name: of the sensor and of its frame.
        T_base_sensor: (4, 4) where it is in the frame of the first sensor; of a camera, its optical frame.
        lens: of a camera; None: it is none.
    """

    name: str
    T_base_sensor: Floats
    lens: CameraIntrinsics | None = None


def static_transforms(parent: str, child: str, T_parent_child: Floats) -> dict[str, str]:
    """Return the command lines of ROS 1 and ROS 2 that publish a transform, and the URDF origin of a fixed joint.

    Args:
        parent: name of the parent frame; what a shell would take for more than a word is quoted.
        child: name of the child frame.
        T_parent_child: (4, 4) pose of the child in the parent.
    """
    x, y, z = (f"{value:.9g}" for value in T_parent_child[:3, 3])
    rotation = Rotation.from_matrix(T_parent_child[:3, :3])
    qx, qy, qz, qw = (f"{value:.9g}" for value in rotation.as_quat(canonical=True))
    parent, child = shell_word(parent), shell_word(child)
    return {
        "ros1": f"rosrun tf2_ros static_transform_publisher {x} {y} {z} {qx} {qy} {qz} {qw} {parent} {child}",
        "ros2": (
            f"ros2 run tf2_ros static_transform_publisher --x {x} --y {y} --z {z} "
            f"--qx {qx} --qy {qy} --qz {qz} --qw {qw} --frame-id {parent} --child-frame-id {child}"
        ),
        "urdf": _origin(T_parent_child),
    }


def kalibr_camchain(sensors: Sequence[Mounted]) -> dict[str, Any]:
    """Return a camchain in Kalibr's form; `T_cam_lidar`, of the first sensor's frame, stands where `T_cam_imu` would.

    Raises:
        InputError: there is no camera, or one has more distortion terms than any of Kalibr's models.
    """
    chain: dict[str, Any] = {}
    before: Floats | None = None
    for sensor in sensors:
        camera = sensor.lens
        if camera is None:
            continue
        model, coefficients = kalibr_distortion(camera)
        T_camera_base = inverse(sensor.T_base_sensor)
        entry: dict[str, Any] = {
            "camera_model": "pinhole",
            "intrinsics": [float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "distortion_model": model,
            "distortion_coeffs": coefficients,
            "resolution": [int(camera.width), int(camera.height)],
            "rostopic": f"/{sensor.name}/image_raw",
            "T_cam_lidar": T_camera_base.tolist(),
        }
        if before is not None:
            entry["T_cn_cnm1"] = (T_camera_base @ before).tolist()
        chain[f"cam{len(chain)}"], before = entry, sensor.T_base_sensor
    if not chain:
        raise InputError("a camchain is of cameras; there is none")
    return chain


def kalibr_distortion(camera: CameraIntrinsics) -> tuple[str, list[float]]:
    """Return Kalibr's name of a distortion model and its coefficients.

    Raises:
        InputError: the camera has more distortion terms than any of Kalibr's models.
    """
    coefficients = [float(x) for x in camera.D]
    if camera.model == "equidistant":
        return "equidistant", coefficients
    if not any(coefficients):
        return "none", []
    if any(coefficients[4:]):
        raise InputError(
            f"camera '{camera.name}': {len(coefficients)} distortion terms; Kalibr's radtan model has k1, k2, p1, p2"
        )
    return "radtan", coefficients[:4]


def urdf(sensors: Sequence[Mounted], name: str = "rig") -> str:
    """Return a robot description: a link for each sensor, tied to the first one's by a fixed joint."""
    base = markup(sensors[0].name)
    lines = ['<?xml version="1.0"?>', f'<robot name="{markup(name)}">', f'  <link name="{base}"/>']
    for sensor in sensors[1:]:
        child = markup(sensor.name)
        lines += [
            f'  <link name="{child}"/>',
            f'  <joint name="{base}_{child}" type="fixed">',
            f'    <parent link="{base}"/>',
            f'    <child link="{child}"/>',
            f"    {_origin(sensor.T_base_sensor)}",
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>", ""])


def autoware(sensors: Sequence[Mounted]) -> dict[str, Any]:
    """Return Autoware's `sensor_kit_calibration.yaml`: each sensor's place in the kit, whose frame is the first one's.

    A camera's entry is its link (x forward), as Autoware's descriptions make the optical frame of it; a LiDAR's its
    base link.
    """
    kit = {}
    for sensor in sensors:
        camera = sensor.lens is not None
        T = sensor.T_base_sensor @ OPTICAL_OF_LINK if camera else sensor.T_base_sensor
        roll, pitch, yaw = Rotation.from_matrix(T[:3, :3]).as_euler("xyz").tolist()
        x, y, z = T[:3, 3].tolist()
        link = f"{sensor.name}/camera_link" if camera else f"{sensor.name}_base_link"
        kit[link] = {"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw}
    return {"sensor_kit_base_link": kit}


EXPORTS = {
    "camchain.yaml": "Kalibr",
    "rig.urdf": "URDF",
    "static_transforms.ros1.sh": "ROS 1",
    "static_transforms.ros2.sh": "ROS 2",
    "sensor_kit_calibration.yaml": "Autoware",
}
"""Names of the files that `write_exports` writes, and who reads them; the first one where there are cameras."""


def write_exports(folder: str | Path, sensors: Sequence[Mounted]) -> list[Path]:
    """Write where sensors are in every form that there is, into a folder.

    Returns:
        The paths of the files.

    Raises:
        InputError: a file cannot be written, or a camera's lens has no form in Kalibr.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    lines = [static_transforms(sensors[0].name, s.name, s.T_base_sensor) for s in sensors[1:]]
    written = []
    for name in EXPORTS:
        path = folder / name
        if name == "camchain.yaml":
            if all(sensor.lens is None for sensor in sensors):
                continue
            write_yaml(path, kalibr_camchain(sensors))
        elif name == "rig.urdf":
            write_atomically(path, urdf(sensors))
        elif name == "sensor_kit_calibration.yaml":
            write_yaml(path, autoware(sensors))
        else:
            # Each keeps running: the script waits for all of them.
            ros = name.split(".")[1]
            write_atomically(path, "\n".join(["#!/bin/sh", *(f"{line[ros]} &" for line in lines), "wait", ""]))
        written.append(path)
    return written


def _origin(T: Floats) -> str:
    x, y, z = (f"{value:.9g}" for value in T[:3, 3])
    roll, pitch, yaw = (f"{value:.9g}" for value in Rotation.from_matrix(T[:3, :3]).as_euler("xyz"))
    return f'<origin xyz="{x} {y} {z}" rpy="{roll} {pitch} {yaw}"/>'
