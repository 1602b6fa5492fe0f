"""A LiDAR's own calibration: its rings' ranges, elevations and azimuths, by boards that stand still."""

from optshape_graph.calibration.sensor.calibrate import calibrate_placements, calibrate_sensor
from optshape_graph.calibration.sensor.known import Distance
from optshape_graph.calibration.sensor.placements import Placement, Sighting, gather
from optshape_graph.calibration.sensor.result import SensorCalibration

__all__ = [
    "Distance",
    "Placement",
    "SensorCalibration",
    "Sighting",
    "calibrate_placements",
    "calibrate_sensor",
    "gather",
]
