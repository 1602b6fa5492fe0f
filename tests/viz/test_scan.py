"""Pictures of scans: outlines where the targets are, crosses where something was turned down."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from optshape_graph.detection import detect_targets
from optshape_graph.io import load_sensor, load_target
from optshape_graph.simulation import NoiseModel, Patch, Scene, pose_from_rpy, room, simulate
from optshape_graph.viz import scan as viz
from tests.viz.legible import assert_legible

SENSOR = load_sensor("vlp32c")
TARGETS = [load_target("paper"), load_target("triangle")]
POSES = [pose_from_rpy([5, 1, 0], np.radians([10, 5, 20])), pose_from_rpy([4, -3, 0.2], np.radians([0, 0, -30]))]


@pytest.fixture(scope="module")
def simulated():
    scene = room(list(zip(TARGETS, POSES, strict=True)), (16.0, 12.0, 4.0))
    return simulate(scene, SENSOR, noise=NoiseModel.of(SENSOR), name="room")


def outlines(figure):
    return [line.get_xydata()[:-1] for line in figure.axes[1].lines if line.get_linewidth() > 2]


def test_a_simulated_scan_shows_the_truth(simulated):
    figure = viz.plot_simulation(simulated)
    assert_legible(figure)
    for drawn, target, T in zip(outlines(figure), TARGETS, POSES, strict=True):
        np.testing.assert_allclose(drawn, (target.vertices @ T[:3, :3].T + T[:3, 3])[:, :2])


def test_detections_are_outlined_and_rejections_crossed(simulated):
    detections = detect_targets(simulated.scan, TARGETS[:1])
    figure = viz.plot_detections(simulated.scan, detections)
    assert_legible(figure)
    assert len(outlines(figure)) == len(detections.found) == 1
    crosses = [line for line in figure.axes[1].lines if line.get_marker() == "x"]
    elsewhere = [r for r in detections.rejected if np.linalg.norm(r.centre - POSES[0][:3, 3]) > 1.0]
    assert sum(len(line.get_xdata()) for line in crosses) == len(elsewhere)
    assert "1 target found" in figure.get_suptitle()
    reach, ranges = figure.axes[1].get_xlim()[1], np.linalg.norm(simulated.scan.points, axis=1)
    beyond = np.mean(np.abs(simulated.scan.points[:, :2]).max(axis=1) > reach)
    said = f"from above ({beyond:.0%} of the returns are beyond, to {ranges.max():.0f} m)"
    assert figure.axes[1].get_title() == (said if beyond else "from above")


def test_a_target_across_the_seam_is_drawn_at_both_ends():
    behind = pose_from_rpy([-5.0, 0.1, 0.0], np.radians([10, 5, 190]))
    figure = viz.plot_simulation(simulate(room([(TARGETS[0], behind)], (16.0, 12.0, 4.0)), SENSOR))
    drawn = [line.get_xdata() for line in figure.axes[0].lines]
    assert len(drawn) == 2
    assert max(np.ptp(azimuth) for azimuth in drawn) < 20.0
    assert min(figure.axes[0].get_xlim()) > -200.0


def test_returns_of_one_target_fill_the_picture():
    scene = Scene((Patch(TARGETS[0], POSES[0]),))
    figure = viz.plot_simulation(simulate(scene, SENSOR))
    assert_legible(figure)
    left, right = figure.axes[1].get_xlim()
    assert right - left < 4.0


def test_a_large_scan_is_thinned(monkeypatch, simulated):
    monkeypatch.setattr(viz, "MOST_RETURNS", 1000)
    figure = viz.plot_scan(simulated.scan, title="thinned")
    assert len(figure.axes[0].collections[0].get_offsets()) <= 1000
    assert figure.get_suptitle() == "thinned"
