"""Pictures of a motion-capture calibration on the bundled session."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")

import optshape_graph
from optshape_graph.calibration.mocap import calibrate_mocap
from optshape_graph.calibration.mocap.comparison import mean_error
from optshape_graph.viz import mocap as viz
from tests.viz.legible import assert_legible

DEMO = Path(optshape_graph.__file__).parent / "data/demo/session.yaml"


@pytest.fixture(scope="module")
def calibrated():
    calibration = calibrate_mocap(DEMO)
    return calibration.scans, calibration


def test_errors_are_those_of_the_calibration(calibrated):
    _, calibration = calibrated
    figure = viz.plot_calibration_errors(calibration)
    assert_legible(figure)
    for axes, field, scale in zip(figure.axes, ("rmse_m", "e_t_m", "e_r_deg"), (1e3, 1e3, 1.0), strict=True):
        points, mean = axes.lines[:2]
        np.testing.assert_allclose(points.get_xdata(), [scale * getattr(e, field) for e in calibration.leave_one_out])
        assert mean.get_xdata()[0] == pytest.approx(scale * getattr(mean_error(calibration.leave_one_out), field))
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()] == [e.scan for e in calibration.leave_one_out]


def test_methods_stand_side_by_side_even_where_one_has_no_number(calibrated):
    _, calibration = calibrated
    errors = calibration.leave_one_out
    rows = [
        {"session": "s", "scan": e.scan, "rmse_m": e.rmse_m, "e_t_m": e.e_t_m, "e_r_deg": e.e_r_deg,
         "published_rmse_m": None, "published_e_t_m": None, "published_e_r_deg": None}
        for e in errors
    ]  # fmt: skip
    rows[0] |= {"published_rmse_m": 0.03, "published_e_t_m": 0.02, "published_e_r_deg": 1.0}
    figure = viz.plot_table(rows, {"": "ours", "published_": "paper"})
    assert_legible(figure)
    assert figure.axes[0].lines[2].get_xdata()[0] == pytest.approx(30.0)
    assert np.isnan(figure.axes[0].lines[2].get_xdata()[1:]).all()


@pytest.mark.parametrize("sd", [1e-5, 0.05])
def test_a_line_that_is_too_small_to_be_seen_is_not_explained(calibrated, sd):
    _, calibration = calibrated
    known = replace(calibration, layout_sigma=np.full_like(calibration.layout_sigma, sd))
    (legend,) = viz.plot_marker_layout(known).legends
    assert ("dotted" in legend.get_title().get_text()) == (sd > 0.01)
    assert f"± {1e3 * sd:.1f}" in legend.get_texts()[0].get_text()


def test_placements_show_targets_and_markers_in_one_frame(calibrated):
    scans, calibration = calibrated
    figure = viz.plot_placements(calibration)
    assert_legible(figure)
    lines = figure.axes[0].lines[1:]
    for scan, target, markers in zip(scans, lines[::2], lines[1::2], strict=True):
        np.testing.assert_allclose(target.get_xydata()[:-1], scan.estimate.vertices[:, :2])
        assert np.abs(markers.get_xydata() - target.get_xydata()[:-1]).max() < 0.05


def test_the_layout_tells_how_far_markers_are(calibrated):
    scans, calibration = calibrated
    figure = viz.plot_marker_layout(calibration)
    assert_legible(figure)
    offsets = 1e3 * np.linalg.norm(calibration.marker_layout - scans[0].estimate.target.vertices, axis=1)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [text.split(" mm")[0] for text in texts] == [f"vertex {k}: {x:.0f}" for k, x in enumerate(offsets)]
