"""What a scan shows of a target: measured before its pose is known, and asked at a pose.

Every method of estimating a pose begins with `measure` and ends with a `Finding`.
"""

from optshape_graph.pose.evidence.coverage import Coverage, coverages
from optshape_graph.pose.evidence.measuring import measure
from optshape_graph.pose.evidence.records import Evidence, Finding, ends_of
from optshape_graph.pose.evidence.residuals import OUTLYING, PLANE, PlaneResiduals, Sheets, Surface

__all__ = [
    "OUTLYING",
    "PLANE",
    "Coverage",
    "Evidence",
    "Finding",
    "PlaneResiduals",
    "Sheets",
    "Surface",
    "coverages",
    "ends_of",
    "measure",
]
