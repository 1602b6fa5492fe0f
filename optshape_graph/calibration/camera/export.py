"""A calibration as other programs read it: JSON, Kalibr's camchain, ROS static transforms, URDF."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.calibrate import CameraCalibration, ViewResult
from optshape_graph.calibration.free_shape import MeasuredShape
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.se3 import inverse, inverse_covariance


def as_document(calibration: CameraCalibration) -> dict[str, Any]:
    """Return the JSON form, `schema: optshape/camera-calibration/1`.

    With one LiDAR and one camera the transform stands at the top; with several, `extrinsics` lists every pair, and
    the top repeats the first.
    """
    pairs = [_pair(calibration, lidar, camera) for camera in calibration.cameras for lidar in calibration.lidars]
    several = len(pairs) > 1
    biases = [_lidar_errors(calibration, lidar) for lidar in calibration.lidars]
    document: dict[str, Any] = {"schema": "optshape/camera-calibration/1", **pairs[0], **biases[0]}
    if several:
        document["extrinsics"] = pairs
        document["lidars"] = [
            {"lidar": lidar, **bias, **_lidar_pair(calibration, lidar)}
            for lidar, bias in zip(calibration.lidars, biases, strict=True)
        ]
    document["discrepancy"] = {
        "rotation_deg": float(np.degrees(calibration.discrepancy.rotation)),
        "translation_m": calibration.discrepancy.translation,
    }
    document["views"] = [_view(result) for result in calibration.views]
    for key, validation in zip(("cross_validation", "k_fold"), calibration.cross_validations, strict=True):
        document[key] = {"protocol": validation.protocol, "views": len(validation.views), **validation.means()}
    document["cameras"] = [
        {**_camera(calibration.rig.cameras[name]), "refined": name in calibration.refined}
        for name in calibration.cameras
    ]
    document["targets"] = [_shape(lidar, shape) for (lidar, _), shape in calibration.shapes.items()]
    document["warnings"] = list(calibration.warnings)
    return document


def kalibr_camchain(calibration: CameraCalibration) -> dict[str, Any]:
    """Return a camchain in Kalibr's form; `T_cam_lidar` (of the base LiDAR) stands where `T_cam_imu` would.

    Raises:
        InputError: a camera has more distortion terms than any of Kalibr's models.
    """
    chain: dict[str, Any] = {}
    for k, name in enumerate(calibration.cameras):
        camera = calibration.rig.cameras[name]
        model, coefficients = _kalibr_distortion(camera)
        entry: dict[str, Any] = {
            "camera_model": "pinhole",
            "intrinsics": [float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "distortion_model": model,
            "distortion_coeffs": coefficients,
            "resolution": [int(camera.width), int(camera.height)],
            "rostopic": f"/{name}/image_raw",
            "T_cam_lidar": calibration.transform(name, calibration.lidars[0])[0].tolist(),
        }
        if k:
            entry["T_cn_cnm1"] = calibration.transform(name, calibration.cameras[k - 1])[0].tolist()
        chain[f"cam{k}"] = entry
    return chain


def _kalibr_distortion(camera: CameraIntrinsics) -> tuple[str, list[float]]:
    """Return Kalibr's name of a distortion model and its coefficients."""
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


def static_transforms(parent: str, child: str, T_parent_child: Floats) -> dict[str, str]:
    """Return the command lines of ROS 1 and ROS 2 that publish a transform, and the URDF origin of a fixed joint.

    Args:
        parent: name of the parent frame.
        child: name of the child frame.
        T_parent_child: (4, 4) pose of the child in the parent.
    """
    x, y, z = (f"{value:.9g}" for value in T_parent_child[:3, 3])
    rotation = Rotation.from_matrix(T_parent_child[:3, :3])
    qx, qy, qz, qw = (f"{value:.9g}" for value in rotation.as_quat(canonical=True))
    roll, pitch, yaw = (f"{value:.9g}" for value in rotation.as_euler("xyz"))
    return {
        "ros1": f"rosrun tf2_ros static_transform_publisher {x} {y} {z} {qx} {qy} {qz} {qw} {parent} {child}",
        "ros2": (
            f"ros2 run tf2_ros static_transform_publisher --x {x} --y {y} --z {z} "
            f"--qx {qx} --qy {qy} --qz {qz} --qw {qw} --frame-id {parent} --child-frame-id {child}"
        ),
        "urdf": f'<origin xyz="{x} {y} {z}" rpy="{roll} {pitch} {yaw}"/>',
    }


def _pair(calibration: CameraCalibration, lidar: str, camera: str) -> dict[str, Any]:
    T_camera_lidar, covariance = calibration.transform(camera, lidar)
    T_lidar_camera = inverse(T_camera_lidar)
    found: dict[str, Any] = {
        "camera": camera,
        "lidar": lidar,
        "T_camera_lidar": T_camera_lidar.tolist(),
        "covariance": covariance.tolist(),
        "T_lidar_camera": T_lidar_camera.tolist(),
        "covariance_T_lidar_camera": inverse_covariance(T_camera_lidar, covariance).tolist(),
        "static_transforms": {
            "T_lidar_camera": static_transforms(lidar, camera, T_lidar_camera),
            "T_camera_lidar": static_transforms(camera, lidar, T_camera_lidar),
        },
        "directions": [
            {"direction": direction.text, "sigma_m": direction.sigma_m}
            for direction in calibration.directions(lidar, camera)
        ],
    }
    if (suggestion := calibration.next_placement(lidar, camera)) is not None:
        found["next_placement"] = {
            "T_lidar_target": suggestion.T_lidar_target.tolist(),
            "yaw_deg": suggestion.yaw_deg,
            "pitch_deg": suggestion.pitch_deg,
            "worst_direction": suggestion.worst,
            "sigma_m": suggestion.sigma_m,
            "expected_sigma_m": suggestion.expected_sigma_m,
        }
    return found


def _lidar_pair(calibration: CameraCalibration, lidar: str) -> dict[str, Any]:
    base = calibration.lidars[0]
    if lidar == base:
        return {}
    T, covariance = calibration.transform(base, lidar)
    return {"base": base, "T_base_lidar": T.tolist(), "covariance": covariance.tolist()}


def _lidar_errors(calibration: CameraCalibration, lidar: str) -> dict[str, float | None]:
    value, sigma = calibration.range_bias(lidar)
    inset = float(np.degrees(calibration.edge_inset(lidar)))
    return {"range_bias_m": value, "range_bias_sigma_m": sigma, "edge_inset_deg": inset if np.isfinite(inset) else None}


def _shape(lidar: str, shape: MeasuredShape) -> dict[str, Any]:
    return {
        "target": shape.target.name,
        "lidar": lidar,
        "sides_m": shape.target.edge_lengths.tolist(),
        "measured_sides_m": shape.joint.sides.tolist(),
        "sigma_m": np.sqrt(np.diag(shape.joint.sides_covariance)).tolist(),
        "measured_vertices": shape.joint.polygon.tolist(),
        "agrees": shape.agrees,
        "beam_crossing": shape.beam_crossing,
        "mean_absolute_error_m": shape.mean_absolute_error,
        "scans": [{"scan": scan.name, "measured_sides_m": scan.sides.tolist()} for scan in shape.scans],
    }


def _view(result: ViewResult) -> dict[str, Any]:
    nothing = dict.fromkeys(("centre_error_mm", "plane_offset_mm", "normal_error_deg", "reprojection_px"))
    return {
        "scan": result.view.scan_name,
        "image": result.view.image_name,
        "target": result.view.target.name,
        "lidar": result.view.scan.lidar if result.view.scan else None,
        "camera": result.view.image.camera.name if result.view.image else None,
        "used": result.used,
        "reason": result.reason,
        **(asdict(result.errors) if result.errors is not None else nothing),
    }


def _camera(camera: CameraIntrinsics) -> dict[str, Any]:
    return {
        "name": camera.name,
        "model": camera.model,
        "width": int(camera.width),
        "height": int(camera.height),
        "K": np.asarray(camera.K).tolist(),
        "D": np.asarray(camera.D).tolist(),
    }
