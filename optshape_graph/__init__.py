"""Certified LiDAR target landmarks for GTSAM.

The nouns and one function for each common job are here; the functions are imported when they are first used.
Everything else is in the subpackage named after it: `io` reads and writes files, `pose` estimates one target in one
scan, `factors` makes GTSAM factors of estimates, `graph` solves several scans and targets together, `calibration` and
`mapping` build on it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from optshape_graph.errors import EstimationError, InputError, MissingExtraError, OptshapeError, UnobservableError
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Chessboard, Target

if TYPE_CHECKING:
    from optshape_graph.calibration.camera import CameraCalibration, calibrate_camera
    from optshape_graph.calibration.mocap import MocapCalibration, calibrate_mocap
    from optshape_graph.calibration.rig import RigCalibration, calibrate_rig
    from optshape_graph.detection import Detections, detect_targets
    from optshape_graph.io import load_sensor, load_session, load_target, read_scan
    from optshape_graph.mapping import Map, load_map, map_recording, save_map
    from optshape_graph.pose import PoseEstimate, estimate_pose

__version__ = "0.1.0"

_HOME = {
    "CameraCalibration": "calibration.camera",
    "Detections": "detection",
    "Map": "mapping",
    "MocapCalibration": "calibration.mocap",
    "PoseEstimate": "pose",
    "RigCalibration": "calibration.rig",
    "calibrate_camera": "calibration.camera",
    "calibrate_mocap": "calibration.mocap",
    "calibrate_rig": "calibration.rig",
    "detect_targets": "detection",
    "estimate_pose": "pose",
    "load_map": "mapping",
    "map_recording": "mapping",
    "load_sensor": "io",
    "load_session": "io",
    "load_target": "io",
    "read_scan": "io",
    "save_map": "mapping",
}
"""Names that are imported when they are first used, and the subpackage that each comes from."""

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
    "SensorModel",
    "Target",
    "UnobservableError",
    "__version__",
    "calibrate_camera",
    "calibrate_mocap",
    "calibrate_rig",
    "detect_targets",
    "estimate_pose",
    "load_map",
    "load_sensor",
    "load_session",
    "load_target",
    "map_recording",
    "read_scan",
    "save_map",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'optshape_graph' has no attribute '{name}'")
    found = getattr(import_module(f"optshape_graph.{_HOME[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
