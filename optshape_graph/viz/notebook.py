"""Pictures of results for notebooks: one for each class, drawn from the result alone."""

from __future__ import annotations

import base64
from io import BytesIO
from typing import TYPE_CHECKING

from optshape_graph.calibration.camera import CameraCalibration
from optshape_graph.calibration.mocap import MocapCalibration
from optshape_graph.calibration.rig import RigCalibration
from optshape_graph.calibration.sensor import SensorCalibration
from optshape_graph.detection import Detections
from optshape_graph.errors import MissingExtraError
from optshape_graph.evaluation import Table, summarise
from optshape_graph.mapping import Map
from optshape_graph.pose import PoseEstimate
from optshape_graph.viz.camera import plot_view_errors
from optshape_graph.viz.evaluation import plot_sweep
from optshape_graph.viz.map import plot_map
from optshape_graph.viz.mocap import plot_calibration_errors
from optshape_graph.viz.pose import plot_edge_labels, plot_vertices
from optshape_graph.viz.rig import plot_rig
from optshape_graph.viz.scan import plot_found
from optshape_graph.viz.sensor import plot_ring_residuals

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 80
"""Dots per inch of pictures in a notebook."""

CELL = ("method", "noise", "orientation", "range_m")
"""Columns of a sweep over distances."""


def picture(result: object) -> str:
    """Return the picture of a result as an HTML image; empty if it has none, or matplotlib is absent.

    Args:
        result: an estimate, detections, a calibration, a map, or the rows of a sweep.
    """
    try:
        figure = _figure(result)
    except MissingExtraError:
        return ""
    if figure is None:
        return ""
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=DPI)
    return f'<img src="data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}">'


def _figure(result: object) -> Figure | None:
    match result:
        case PoseEstimate() if len(result.edge_points):
            return plot_edge_labels(result, result.scan)
        case PoseEstimate() if result.status != "failed":
            return plot_vertices(result, result.scan)
        case Detections():
            return plot_found(result)
        case MocapCalibration():
            return plot_calibration_errors(result)
        case SensorCalibration():
            return plot_ring_residuals(result)
        case CameraCalibration():
            return plot_view_errors(result)
        case RigCalibration():
            return plot_rig(result)
        case Map():
            return plot_map(result)
        case Table() if result and set(CELL) <= result[0].keys():
            return plot_sweep(summarise(result, CELL))
    return None
