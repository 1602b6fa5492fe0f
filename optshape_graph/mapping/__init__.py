"""SLAM with targets as landmarks: incremental and batch, from measurements or from recordings.

`LandmarkSlam` takes odometry and sightings one pose after another; `solve_batch` solves for everything at once; `Map`
is what both make, and a file. `factor_graph` and `MotionFactor` are for those who own their graph.
"""

from optshape_graph.mapping.batch import BatchSolution, factor_graph, solve_batch
from optshape_graph.mapping.incremental import LandmarkSlam, Outcome
from optshape_graph.mapping.map import Landmark, Map, load_map, save_map
from optshape_graph.mapping.merge import merge_maps
from optshape_graph.mapping.motion import MotionFactor, MotionMeasurement, deskew, estimate_moving, solve_motion
from optshape_graph.mapping.recording import MapResult, map_recording
from optshape_graph.mapping.track import MappingProblem, Match, Odometry, Sighting, Start, Track

__all__ = [
    "BatchSolution",
    "Landmark",
    "LandmarkSlam",
    "Map",
    "MapResult",
    "MappingProblem",
    "Match",
    "MotionFactor",
    "MotionMeasurement",
    "Odometry",
    "Outcome",
    "Sighting",
    "Start",
    "Track",
    "deskew",
    "estimate_moving",
    "factor_graph",
    "load_map",
    "map_recording",
    "merge_maps",
    "save_map",
    "solve_batch",
    "solve_motion",
]
