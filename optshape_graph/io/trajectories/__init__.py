"""Trajectories and pose graphs: TUM and tables of poses, KITTI, g2o, and the rigid bodies of motion capture."""

from optshape_graph.io.trajectories.files import is_trajectory, read_rigid_body, read_trajectory
from optshape_graph.io.trajectories.g2o import PoseGraph, PoseGraphEdge, read_g2o, write_g2o
from optshape_graph.io.trajectories.kitti import read_kitti, write_kitti
from optshape_graph.io.trajectories.trajectory import Trajectory
from optshape_graph.io.trajectories.tum import read_tum, write_tum

__all__ = [
    "PoseGraph",
    "PoseGraphEdge",
    "Trajectory",
    "is_trajectory",
    "read_g2o",
    "read_kitti",
    "read_rigid_body",
    "read_trajectory",
    "read_tum",
    "write_g2o",
    "write_kitti",
    "write_tum",
]
