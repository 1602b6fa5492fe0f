"""A calibration in Kalibr's form."""

from __future__ import annotations

from typing import Any

from optshape_graph.calibration.camera.result import CameraCalibration
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError


def kalibr_camchain(calibration: CameraCalibration) -> dict[str, Any]:
    """Return a camchain in Kalibr's form; `T_cam_lidar` (of the base LiDAR) stands where `T_cam_imu` would.

    Raises:
        InputError: a camera has more distortion terms than any of Kalibr's models.
    """
    chain: dict[str, Any] = {}
    for k, name in enumerate(calibration.cameras):
        camera = calibration.rig.cameras[name]
        model, coefficients = kalibr_distortion(camera)
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
