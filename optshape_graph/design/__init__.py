"""Target shapes: the family of candidates, their score, the search for the best, and drawings for the workshop.

Sections III and IV of Huang, Clark and Grizzle, "Optimal Target Shape for LiDAR Pose Estimation", corrected: `family`
makes candidates, `rings` lights them, `sensitivity` scores them, `problem` and `multistart` find the best within
`limits`; `bound` bounds the error of a pose, and `pose_search` finds the shape with the smallest. `judgement` compares
shapes; `drawing`, `patterns` and `formats` draw one at 1:1, `parts` lists what to build it from, and `measured`
corrects a target by its measured sides.
"""

from optshape_graph.design.bound import PoseBound, covariance_bound, pose_bound
from optshape_graph.design.drawing import Workshop, draw
from optshape_graph.design.family import Family
from optshape_graph.design.formats import export
from optshape_graph.design.judgement import Judgement, judge, worst_cell
from optshape_graph.design.limits import Limits
from optshape_graph.design.measured import as_measured
from optshape_graph.design.multistart import Search, search
from optshape_graph.design.parts import parts_list
from optshape_graph.design.polylines import Drawing
from optshape_graph.design.problem import Problem, Start
from optshape_graph.design.rings import Rings, SensorRings, UniformRings
from optshape_graph.design.sensitivity import cell_scores, edge_crossings
from optshape_graph.design.symmetry import SelfRotation, nearest_self_rotation

__all__ = [
    "Drawing",
    "Family",
    "Judgement",
    "Limits",
    "PoseBound",
    "Problem",
    "Rings",
    "Search",
    "SelfRotation",
    "SensorRings",
    "Start",
    "UniformRings",
    "Workshop",
    "as_measured",
    "cell_scores",
    "covariance_bound",
    "draw",
    "edge_crossings",
    "export",
    "judge",
    "nearest_self_rotation",
    "parts_list",
    "pose_bound",
    "search",
    "worst_cell",
]
