"""Simulated scans with known truth: sensors, scenes, noise.

`simulate_target` returns one target's returns; `simulate` a full revolution in a `Scene`, of a sensor at rest or
moving.
"""

from optshape_graph.simulation.mesh import Mesh
from optshape_graph.simulation.motion import ConstantTwist, Motion, Trajectory
from optshape_graph.simulation.noise import IDEAL, NoiseModel
from optshape_graph.simulation.placement import pose_from_rpy
from optshape_graph.simulation.rays import AngleErrors
from optshape_graph.simulation.room import room
from optshape_graph.simulation.scene import (
    Scene,
    SimulatedScan,
    random_rings,
    simulate,
    simulate_target,
    without_rings,
)
from optshape_graph.simulation.scene_file import load_scene
from optshape_graph.simulation.session import synthetic_session
from optshape_graph.simulation.surfaces import Box, Floor, Patch, Surface
from optshape_graph.simulation.truth import write_simulation
from optshape_graph.simulation.uniform import spinning_at, uniform_sensor

__all__ = [
    "IDEAL",
    "AngleErrors",
    "Box",
    "ConstantTwist",
    "Floor",
    "Mesh",
    "Motion",
    "NoiseModel",
    "Patch",
    "Scene",
    "SimulatedScan",
    "Surface",
    "Trajectory",
    "load_scene",
    "pose_from_rpy",
    "random_rings",
    "room",
    "simulate",
    "simulate_target",
    "spinning_at",
    "synthetic_session",
    "uniform_sensor",
    "without_rings",
    "write_simulation",
]
