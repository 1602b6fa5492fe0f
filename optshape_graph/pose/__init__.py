"""One target in one scan: association, posterior, certificate."""

from optshape_graph.factors.measurement import refine
from optshape_graph.pose.certificate import Backend, Certificate, certify, solve_relaxation
from optshape_graph.pose.estimate import Method, estimate_pose, estimate_poses
from optshape_graph.pose.options import PoseOptions
from optshape_graph.pose.result import Ambiguity, PoseEstimate

__all__ = [
    "Ambiguity",
    "Backend",
    "Certificate",
    "Method",
    "PoseEstimate",
    "PoseOptions",
    "certify",
    "estimate_pose",
    "estimate_poses",
    "refine",
    "solve_relaxation",
]
