"""Calibration of a LiDAR to motion capture: `calibrate_mocap(session)`."""

from optshape_graph.calibration.mocap.calibrate import calibrate_mocap
from optshape_graph.calibration.mocap.result import MocapCalibration

__all__ = ["MocapCalibration", "calibrate_mocap"]
