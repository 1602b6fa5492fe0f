"""Errors of a camera calibration's views."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from optshape_graph.viz.camera import plot_view_errors
from tests.viz.legible import assert_legible


def test_every_view_has_its_errors(camera_calibration):
    figure = plot_view_errors(camera_calibration)
    assert_legible(figure)
    for axes, field in zip(
        figure.axes, ("centre_error_mm", "plane_offset_mm", "normal_error_deg", "reprojection_px"), strict=True
    ):
        drawn = next(line for line in axes.lines if line.get_label() == "used").get_xdata()
        np.testing.assert_allclose(drawn, [getattr(result.errors, field) for result in camera_calibration.views])


def test_views_that_are_not_used_are_told_apart(camera_calibration):
    first, *others = camera_calibration.views
    doubted = replace(camera_calibration, views=(replace(first, used=False, reason="outlier"), *others))
    lines = {line.get_label(): line for line in plot_view_errors(doubted).axes[0].lines}
    assert len(lines["not used"].get_xdata()) == 1
    assert len(lines["used"].get_xdata()) == len(others)
