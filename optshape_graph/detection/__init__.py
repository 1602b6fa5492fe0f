"""Targets in full scans: returns of a target's size in one plane, each candidate judged by the pose estimator."""

from optshape_graph.detection.detect import Search, detect_in_scans, detect_targets, unsearchable
from optshape_graph.detection.options import DetectionOptions
from optshape_graph.detection.results import Detection, Detections, Evidence, Rejection
from optshape_graph.detection.tracker import TargetTracker

__all__ = [
    "Detection",
    "DetectionOptions",
    "Detections",
    "Evidence",
    "Rejection",
    "Search",
    "TargetTracker",
    "detect_in_scans",
    "detect_targets",
    "unsearchable",
]
