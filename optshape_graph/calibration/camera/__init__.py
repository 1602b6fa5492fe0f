"""Calibration of LiDARs and cameras from views of targets: `calibrate_camera(session)`."""

from optshape_graph.calibration.camera.calibrate import calibrate_camera
from optshape_graph.calibration.camera.result import CameraCalibration

__all__ = ["CameraCalibration", "calibrate_camera"]
