"""Certified LiDAR target landmarks for GTSAM.

The nouns and one function for each common job are here; the functions are imported when they are first used.
Everything else is in the subpackage named after it: `io` reads and writes files, `pose` estimates one target in one
scan, `factors` makes GTSAM factors of estimates, `graph` solves several scans and targets together, `calibration` and
`mapping` build on it.
"""

from typing import TYPE_CHECKING

from optshape_graph._lazy import lazy
from optshape_graph._version import __version__
from optshape_graph.errors import EstimationError, InputError, MissingExtraError, OptshapeError, UnobservableError

if TYPE_CHECKING:
    from optshape_graph.calibration.camera import CameraCalibration, calibrate_camera
    from optshape_graph.calibration.mocap import MocapCalibration, calibrate_mocap
    from optshape_graph.calibration.rig import RigCalibration, calibrate_rig
    from optshape_graph.calibration.sensor import SensorCalibration, calibrate_sensor
    from optshape_graph.detection import Detections, detect_targets
    from optshape_graph.io import load_sensor, load_session, load_target, read_scan
    from optshape_graph.mapping import Map, load_map, map_recording, save_map
    from optshape_graph.pose import PoseEstimate, estimate_pose, estimate_poses
    from optshape_graph.scan import Scan
    from optshape_graph.sensor import SensorModel
    from optshape_graph.target import Chessboard, Target

_HOME = {
    "calibration.camera": "CameraCalibration calibrate_camera",
    "calibration.mocap": "MocapCalibration calibrate_mocap",
    "calibration.rig": "RigCalibration calibrate_rig",
    "calibration.sensor": "SensorCalibration calibrate_sensor",
    "detection": "Detections detect_targets",
    "io": "load_sensor load_session load_target read_scan",
    "mapping": "Map load_map map_recording save_map",
    "pose": "PoseEstimate estimate_pose estimate_poses",
    "scan": "Scan",
    "sensor": "SensorModel",
    "target": "Chessboard Target",
}
"""Subpackages, and the names that are imported from them when they are first used."""

__all__ = [
    "CameraCalibration",
    "Chessboard",
    "Detections",
    "EstimationError",
    "InputError",
    "Map",
    "MissingExtraError",
    "MocapCalibration",
    "OptshapeError",
    "PoseEstimate",
    "RigCalibration",
    "Scan",
    "SensorCalibration",
    "SensorModel",
    "Target",
    "UnobservableError",
    "__version__",
    "calibrate_camera",
    "calibrate_mocap",
    "calibrate_rig",
    "calibrate_sensor",
    "detect_targets",
    "estimate_pose",
    "estimate_poses",
    "load_map",
    "load_sensor",
    "load_session",
    "load_target",
    "map_recording",
    "read_scan",
    "save_map",
]

__getattr__, __dir__ = lazy(__name__, _HOME)
