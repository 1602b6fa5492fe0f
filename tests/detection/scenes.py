"""Full scans with known truth."""

from dataclasses import replace

import numpy as np

from optshape_graph import SensorModel, Target
from optshape_graph.detection import Detection, Detections
from optshape_graph.simulation import Box, NoiseModel, Patch, Scene, SimulatedScan, Surface, pose_from_rpy, simulate

HALL = Box(np.array([40.0, 36.0, 6.0]), pose_from_rpy([0.0, 0.0, 1.2]))
"""A room around the sensor, its floor 1.8 m below."""

BOARD = Target.from_polygon([[0, 0], [0.61, 0], [0.61, 0.85], [0, 0.85]], "board")


def pose(x: float, y: float, z: float, *rpy_deg: float) -> np.ndarray:
    """(4, 4) pose of a target or a box, angles in degrees."""
    return pose_from_rpy([x, y, z], np.radians(rpy_deg or (0.0, 0.0, 0.0)))


def scan_of(
    sensor: SensorModel, targets: list[tuple[Target, np.ndarray]], *things: Surface, seed: int = 0
) -> SimulatedScan:
    """One revolution in the hall, with the noise that the sensor's model says."""
    scene = Scene(tuple(Patch(target, T) for target, T in targets), (HALL, *things))
    return simulate(scene, sensor, noise=NoiseModel.of(sensor), rng=seed)


def plain(sensor: SensorModel) -> SensorModel:
    """A sensor whose rings look where its table says; surfaces are equally bright, ring ends what they seem."""
    return replace(sensor, brightness_bias=0.0, blooming=0.0, odd_ends=1e-9, elevation_error=0.0, azimuth_error=0.0)


def shares(found: Detection, simulated: SimulatedScan, k: int = 0) -> tuple[float, float]:
    """Share of target k's returns that are among a detection's, and of the detection's that are not of the target."""
    of_target = simulated.surface[found.indices] == k
    return float(of_target.sum() / (simulated.surface == k).sum()), float(1 - of_target.mean())


def only(detections: Detections) -> Detection:
    """The one detection there is."""
    assert len(detections.found) == 1, [one.reason for one in detections.rejected]
    return detections.found[0]
