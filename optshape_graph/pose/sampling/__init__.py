"""Poses that are drawn, and weighed by the likelihood of the scan as it is."""

from optshape_graph.pose.sampling.firings import Firings
from optshape_graph.pose.sampling.mixture import Components, LogDensity, Samples, sample
from optshape_graph.pose.sampling.rays import Rays
from optshape_graph.pose.sampling.sampled import SampledPose, sampled_measurement

__all__ = [
    "Components",
    "Firings",
    "LogDensity",
    "Rays",
    "SampledPose",
    "Samples",
    "sample",
    "sampled_measurement",
]
