"""Targets in full scans: returns of a target's size in one plane, each candidate judged by the pose estimator."""

from optshape_graph.detection.detect import detect_targets
from optshape_graph.detection.options import DetectionOptions
from optshape_graph.detection.results import Detection, Detections, Evidence, Rejection
from optshape_graph.detection.tracker import TargetTracker

__all__ = ["Detection", "DetectionOptions", "Detections", "Evidence", "Rejection", "TargetTracker", "detect_targets"]
