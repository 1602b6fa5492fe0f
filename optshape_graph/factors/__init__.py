"""GTSAM factors of planar polygonal targets. Usable alone, with edge points and a factor graph of one's own.

One scan of a square target, its edge points and their edges known, on the pose T_target_lidar:

>>> import gtsam, numpy as np
>>> from gtsam.symbol_shorthand import H
>>> from optshape_graph import Target
>>> from optshape_graph.factors import TemplateFactor, TemplateMeasurement, edge_rows, plane_rows
>>> target = Target.from_polygon([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
>>> edge = np.array([0, 0, 1, 1, 2, 2, 3, 3])
>>> along = np.tile([0.2, 0.9], 4)[:, None]
>>> start, end = target.vertices[edge], target.vertices[(edge + 1) % 4]
>>> points = (1 - along) * start + along * end + [5.0, 0.3, 0.1]  # the target is 5 m ahead of the LiDAR
>>> A, r = edge_rows(points, target.normals[edge], target.offsets[edge])
>>> P, s = plane_rows(points)
>>> sigma = 0.01  # metres
>>> guess = gtsam.Pose3(gtsam.Rot3(), [-4.8, 0.0, 0.0])
>>> measurement = TemplateMeasurement.from_rows(np.vstack([A, P]) / sigma, np.append(r, s) / sigma, guess.matrix())
>>> graph = gtsam.NonlinearFactorGraph()
>>> graph.push_back(TemplateFactor(measurement, H(0)))
>>> values = gtsam.Values()
>>> values.insert(H(0), guess)
>>> solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
>>> (-solution.atPose3(H(0)).translation()).round(6).tolist()
[5.0, 0.3, 0.1]

In a larger graph `SummaryFactor` links T_world_target and T_world_lidar, `VertexFactor` adds the vertices,
`SensorParameterFactor` an inset or a range bias, and `ShapeFactor` leaves the shape itself free.

Names are imported when they are first used: measurements need no GTSAM.
"""

from typing import TYPE_CHECKING

from optshape_graph._lazy import lazy
from optshape_graph.se3 import inverse_covariance

if TYPE_CHECKING:
    from optshape_graph.factors._callback import CheckedFactor
    from optshape_graph.factors.measurement import (
        Measured,
        TemplateMeasurement,
        edge_rows,
        plane_rows,
        refine,
        template_rows,
    )
    from optshape_graph.factors.sensor_parameters import (
        AugmentedMeasurement,
        SensorParameterFactor,
        azimuth_directions,
        edge_motion_rows,
        plane_motion_rows,
        range_directions,
    )
    from optshape_graph.factors.shape import (
        FreeVertexFactor,
        ShapeFactor,
        ShapeMeasurement,
        TemplatePrior,
        VertexFactor,
        shape_rows,
    )
    from optshape_graph.factors.static import (
        AZIMUTH,
        AZIMUTH_TREND,
        BLOOMING,
        BRIGHTNESS,
        COMMON_AZIMUTH,
        COMMON_ELEVATION,
        COMMON_RANGE,
        EDGE_OFFSET,
        ELEVATION,
        ELEVATION_TREND,
        OF_RANGES,
        OF_RINGS,
        OF_SENSOR,
        RANGE_BIAS,
        RANGE_TREND,
        BiasedMeasurement,
        SharedError,
        fuse_static,
        ring_bias_columns,
    )
    from optshape_graph.factors.summary import LandmarkFactor, Summary, SummaryFactor, summarise
    from optshape_graph.factors.template import (
        PointToEdgeFactor,
        PointToPlaneFactor,
        TemplateCallbackFactor,
        TemplateFactor,
    )

_HOME = {
    "_callback": "CheckedFactor",
    "measurement": "Measured TemplateMeasurement edge_rows plane_rows refine template_rows",
    "sensor_parameters": "AugmentedMeasurement SensorParameterFactor azimuth_directions "
    "edge_motion_rows plane_motion_rows range_directions",
    "shape": "FreeVertexFactor ShapeFactor ShapeMeasurement TemplatePrior VertexFactor shape_rows",
    "static": "AZIMUTH AZIMUTH_TREND BLOOMING BRIGHTNESS BiasedMeasurement COMMON_AZIMUTH COMMON_ELEVATION "
    "COMMON_RANGE EDGE_OFFSET ELEVATION ELEVATION_TREND OF_RANGES OF_RINGS OF_SENSOR RANGE_BIAS RANGE_TREND "
    "SharedError fuse_static ring_bias_columns",
    "summary": "LandmarkFactor Summary SummaryFactor summarise",
    "template": "PointToEdgeFactor PointToPlaneFactor TemplateCallbackFactor TemplateFactor",
}

__all__ = [
    "AZIMUTH",
    "AZIMUTH_TREND",
    "BLOOMING",
    "BRIGHTNESS",
    "COMMON_AZIMUTH",
    "COMMON_ELEVATION",
    "COMMON_RANGE",
    "EDGE_OFFSET",
    "ELEVATION",
    "ELEVATION_TREND",
    "OF_RANGES",
    "OF_RINGS",
    "OF_SENSOR",
    "RANGE_BIAS",
    "RANGE_TREND",
    "AugmentedMeasurement",
    "BiasedMeasurement",
    "CheckedFactor",
    "FreeVertexFactor",
    "LandmarkFactor",
    "Measured",
    "PointToEdgeFactor",
    "PointToPlaneFactor",
    "SensorParameterFactor",
    "ShapeFactor",
    "ShapeMeasurement",
    "SharedError",
    "Summary",
    "SummaryFactor",
    "TemplateCallbackFactor",
    "TemplateFactor",
    "TemplateMeasurement",
    "TemplatePrior",
    "VertexFactor",
    "azimuth_directions",
    "edge_motion_rows",
    "edge_rows",
    "fuse_static",
    "inverse_covariance",
    "plane_motion_rows",
    "plane_rows",
    "range_directions",
    "refine",
    "ring_bias_columns",
    "shape_rows",
    "summarise",
    "template_rows",
]

__getattr__, __dir__ = lazy(__name__, _HOME)
