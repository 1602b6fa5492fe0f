"""Certified LiDAR target landmarks for GTSAM.

The nouns are here; everything else is in the subpackage named after it: `io` reads and writes files, `pose`
estimates one target in one scan, `factors` makes GTSAM factors of estimates, `graph` solves several scans and
targets together, `calibration` and `mapping` build on it.
"""

from optshape_graph.errors import EstimationError, InputError, MissingExtraError, OptshapeError, UnobservableError
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Chessboard, Target

__version__ = "0.1.0"

__all__ = [
    "Chessboard",
    "EstimationError",
    "InputError",
    "MissingExtraError",
    "OptshapeError",
    "Scan",
    "SensorModel",
    "Target",
    "UnobservableError",
    "__version__",
]
