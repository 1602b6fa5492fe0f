"""Pictures of a rig: what is drawn is what the calibration says."""

import numpy as np
import pytest

from optshape_graph.evaluation.rigs import SimulatedRig, placements, two_targets
from optshape_graph.io.documents import write_json
from optshape_graph.viz.documents import spatial
from optshape_graph.viz.notebook import picture
from optshape_graph.viz.report import write_report
from optshape_graph.viz.rig import plot_rig, plot_rings, plot_sightings
from tests.calibration.rig.support import calibrated, seen


@pytest.fixture(scope="module")
def result():
    rng = np.random.default_rng(3)
    rig = SimulatedRig.drawn(rng, {"front": "vlp16"}, ("left",))
    return calibrated(rig, seen(rig, two_targets(), placements(5, rng, (0.0, 80.0)), rng))


def test_the_rig_s_places_are_drawn(result):
    figure = plot_rig(result, magnify=10.0)
    above, side = figure.axes[:2]
    place = result.sensors[1].T_base_sensor[:3, 3]
    for axes, (i, j) in ((above, (0, 1)), (side, (0, 2))):
        starts = [line.get_xydata()[0] for line in axes.lines]
        assert any(np.allclose(start, place[[i, j]]) for start in starts)
        assert any(len(line.get_xydata()) > 50 for line in axes.lines)  # an ellipse
    assert "10 times too large" in figure._suptitle.get_text()


def test_sightings_and_rings_are_drawn(result):
    centre = plot_sightings(result).axes[0]
    values = np.concatenate([line.get_ydata() for line in centre.lines[::2]])
    truth = [1e3 * one.centre_error_m for one in result.sightings if one.centre_error_m is not None]
    assert np.allclose(np.sort(values), np.sort(truth))
    assert plot_rings(result).axes[0].get_title() == "front"
    assert picture(result).startswith("<img")


def test_it_is_shown_in_space_and_as_a_report(result, tmp_path):
    write_json(tmp_path / "rig.json", result.to_dict())
    names = [item.name for item in spatial(tmp_path / "rig.json").items]
    assert {"sensors/front/axes", "sensors/left/axes", "sensors/left/3 sd", "next placement"} <= set(names)
    verdict = write_report(tmp_path / "rig.html", result.to_dict())
    assert "1 pair of sensors" in verdict.sentence
    assert "T_front_left" in (tmp_path / "rig.html").read_text()
