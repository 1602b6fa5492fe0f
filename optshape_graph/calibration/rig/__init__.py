"""Any sensors that targets connect, in one graph: LiDARs, cameras, motion-capture bodies."""

from optshape_graph.calibration.rig.calibrate import calibrate, calibrate_rig
from optshape_graph.calibration.rig.result import RigCalibration, RigSensor, SightingResult

__all__ = ["RigCalibration", "RigSensor", "SightingResult", "calibrate", "calibrate_rig"]
