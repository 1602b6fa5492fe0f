"""How well a camera's and a LiDAR's sightings of one target agree under an extrinsic that did not see them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.consistency import pose_alone
from optshape_graph.calibration.camera.graph import Rig, Sighting
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.images.projection import project
from optshape_graph.se3 import apply, inverse
from optshape_graph.target import Target


@dataclass(frozen=True)
class ViewErrors:
    """One view under one extrinsic.

    Attributes:
        centre_error_mm: distance between the target's centre from its LiDAR returns alone, moved by the extrinsic,
            and the centre from its image alone.
        plane_offset_mm: signed distance of the returns' centroid from the camera's plane of the target, along that
            plane's normal; positive behind the plane, seen from the sensors.
        normal_error_deg: angle between the two planes.
        reprojection_px: root mean square distance in the image between the target's vertices as the two see them.
    """

    centre_error_mm: float
    plane_offset_mm: float
    normal_error_deg: float
    reprojection_px: float


@dataclass(frozen=True)
class CrossValidation:
    """Errors of views left out of the calibration that predicts them.

    Attributes:
        protocol: "leave-one-out" or "k-fold, k = 5".
        views: errors by the view's number.
    """

    protocol: str
    views: dict[int, ViewErrors]

    def means(self) -> dict[str, float]:
        """Return the mean of each error; of the plane's offset, the mean absolute and the mean signed one."""
        if not self.views:
            return {}
        rows = [asdict(errors) for errors in self.views.values()]
        means = {f"mean_{f.name}": float(np.mean([row[f.name] for row in rows])) for f in fields(ViewErrors)}
        means["mean_signed_plane_offset_mm"] = means.pop("mean_plane_offset_mm")
        means["mean_absolute_plane_offset_mm"] = float(np.mean([abs(row["plane_offset_mm"]) for row in rows]))
        return means


def view_errors(scan: Sighting, image: Sighting, target: Target, rig: Rig) -> ViewErrors:
    """Compare the two sightings of a view under a rig.

    Args:
        scan: the target in the scan.
        image: the target in the image, read with the scan's labelling.
        target: the target.
        rig: where the sensors are; its range bias is subtracted from the ranges.
    """
    assert isinstance(scan.seen, TargetInScan)
    T_camera_lidar = inverse(rig.T_base_sensor[image.sensor]) @ rig.T_base_sensor[scan.sensor]
    T_camera_target, predicted = pose_alone(image, rig), T_camera_lidar @ pose_alone(scan, rig)
    returns = without_bias(scan.seen.returns, rig.range_bias.get(scan.sensor, 0.0))
    camera = rig.cameras[image.sensor]
    normal, centre = T_camera_target[:3, 0], T_camera_target[:3, 3]
    centroid = T_camera_lidar[:3, :3] @ returns.mean(axis=0) + T_camera_lidar[:3, 3]
    pixels = [project(camera, apply(T, target.vertices)) for T in (predicted, T_camera_target)]
    return ViewErrors(
        centre_error_mm=1e3 * float(np.linalg.norm(predicted[:3, 3] - centre)),
        plane_offset_mm=1e3 * float(normal @ (centroid - centre)),
        normal_error_deg=float(np.degrees(np.arccos(np.clip(predicted[:3, 0] @ normal, -1, 1)))),
        reprojection_px=float(np.sqrt(np.square(pixels[0] - pixels[1]).sum(axis=1).mean())),
    )


def without_bias(points: Floats, range_bias: float) -> Floats:
    """Return points (N, 3), LiDAR frame, with the range bias, metres, subtracted from their ranges."""
    return np.asarray(points * (1 - range_bias / np.linalg.norm(points, axis=1, keepdims=True)))
