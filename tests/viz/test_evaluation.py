"""Charts of sweeps."""

import pytest

from optshape_graph.evaluation import summarise
from tests.viz.legible import assert_legible

pytest.importorskip("matplotlib")


def test_a_line_for_every_method_level_and_orientation():
    from optshape_graph.viz.evaluation import plot_sweep

    rows = [
        {
            "method": method, "noise": noise, "orientation": orientation, "range_m": x, "distance_m": x, "n_points": 9,
            "e_q_m": 0.1, "status": "ok", "rmse_m": 0.01 * x, "e_t_m": 0.01 * x, "e_r_deg": x, "bound_rmse_m": 0.01,
            "bound_e_t_m": 0.01, "bound_e_r_deg": None,
        }
        for method in ("global", "paper") for noise in ("0", "1") for orientation in ("face", "extreme")
        for x in (2.0, 4.0)
    ]  # fmt: skip
    figure = plot_sweep(summarise(rows, ("method", "noise", "orientation", "range_m")))
    assert len(figure.axes) == 6
    assert len(figure.axes[0].get_legend_handles_labels()[1]) == 6  # two levels and the bound, in two orientations
    assert figure.axes[0].containers[0][0].get_ydata() == pytest.approx([0.02, 0.04])
    assert_legible(figure)
