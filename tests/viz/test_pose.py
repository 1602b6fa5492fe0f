"""Pictures of one estimate show what the estimate says."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from optshape_graph import InputError
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import Ambiguity, estimate_pose
from optshape_graph.pose.fit import Flag
from optshape_graph.simulation import NoiseModel, pose_from_rpy, simulate_target
from optshape_graph.viz import pose as viz
from tests.viz.legible import assert_legible

SHAPES = [("paper", 6.0), ("triangle", 4.0), ("optimal5", 8.0), ("square", 6.0)]


def made(name, distance, seed=0):
    sensor, target = load_sensor("vlp32c"), load_target(name)
    T = pose_from_rpy([distance, 0.4, 0.1], np.radians([10.0, 20.0, 15.0]))
    scan = simulate_target(target, sensor, T, noise=NoiseModel.of(sensor), rng=seed, name="/some/where/scan.pcd")
    return scan, estimate_pose(scan, target)


@pytest.fixture(scope="module")
def case():
    return made("paper", 6.0)


@pytest.mark.parametrize(("name", "distance"), SHAPES)
def test_every_picture_is_legible(name, distance):
    scan, estimate = made(name, distance)
    figures = viz.plot_estimate(scan, replace(estimate, status="ok"))
    assert set(figures) == {"fit", "edges", "residuals", "vertices"}
    for figure in figures.values():
        assert_legible(figure)


def test_the_fit_shows_every_return_and_the_template(case):
    scan, estimate = case
    front, side = viz.plot_fit(scan, estimate).axes
    returns, edges, template = front.lines
    assert len(returns.get_xdata()) == len(scan)
    assert len(edges.get_xdata()) == len(estimate.edge_points)
    np.testing.assert_allclose(template.get_xydata()[:-1], estimate.target.polygon)
    assert front.get_xlim()[0] > front.get_xlim()[1]  # y to the left
    depth = side.lines[0].get_xdata()
    assert np.sqrt(np.mean(depth**2)) == pytest.approx(1e3 * estimate.plane_rms)
    assert "scan.pcd: 'paper' at 6.0" in front.figure.get_suptitle()
    assert "/some" not in front.figure.get_suptitle()
    assert "chi-square per degree of freedom: plane " in front.figure.get_suptitle()
    flag = Flag("surface", 2.0, "a fold")
    doubtful = replace(estimate, status="doubtful", fit=replace(estimate.fit, flags=(flag,)))
    assert "does not fit the model: surface" in viz.plot_fit(scan, doubtful).get_suptitle()


def test_residuals_are_said_to_be_those_of_the_boundary(case):
    figure = viz.plot_residuals(*case)
    caption = figure.legends[0].get_title().get_text()
    assert "half an azimuth step beyond" in caption
    assert "negative" not in caption


def test_a_full_scan_is_cut_to_the_target(case):
    scan, estimate = case
    room = replace(scan, points=np.vstack([scan.points, [[0.0, 9.0, 0.0]] * 5]), ring=np.append(scan.ring, [0] * 5),
                   time=None, intensity=None)  # fmt: skip
    returns = viz.plot_fit(room, estimate).axes[0].lines[0]
    assert len(returns.get_xdata()) == len(scan)


def test_every_edge_point_is_at_its_edge(case):
    _, estimate = case
    axes = viz.plot_edge_labels(estimate).axes[0]
    drawn = [line for line in axes.lines if line.get_label().startswith("edge")]
    assert [len(line.get_xdata()) for line in drawn] == [int((estimate.labels == k).sum()) for k in range(4)]


def test_residuals_are_those_of_the_estimate(case):
    scan, estimate = case
    across, depth = viz.plot_residuals(scan, estimate).axes
    drawn = np.concatenate([container[0].get_ydata() for container in across.containers])
    np.testing.assert_allclose(np.sort(drawn), np.sort(1e3 * estimate.edge_residuals))
    assert len(depth.lines[1].get_xdata()) == len(np.unique(scan.ring))


def test_ellipses_are_of_the_vertices(case):
    _, estimate = case
    figure = viz.plot_vertices(estimate)
    loops = [line.get_xydata() for line in figure.axes[0].lines if len(line.get_xdata()) > 20]
    factor = float(figure.get_suptitle().split("drawn ")[1].split()[0])
    R = estimate.T_lidar_target[:3, :3]
    for vertex, C, loop in zip(estimate.target.polygon, estimate.vertex_covariances, loops, strict=True):
        largest = np.sqrt(np.linalg.eigvalsh((R.T @ C @ R)[1:, 1:]).max())
        reach = np.linalg.norm(loop - vertex, axis=1).max()
        assert reach == pytest.approx(3.0 * factor * largest, rel=0.01)


def test_the_runner_up_is_drawn_where_it_is(case):
    scan, estimate = case
    other = estimate.T_lidar_target @ pose_from_rpy([0.0, 0.05, 0.02], np.radians([170.0, 0.0, 0.0]))
    doubtful = replace(estimate, status="ambiguous", ambiguity=Ambiguity(1.5, other))
    figure = viz.plot_estimate(scan, doubtful)["runner_up"]
    assert_legible(figure)
    drawn = figure.axes[0].lines[2].get_xydata()[:-1]
    expected = estimate.target.vertices @ other[:3, :3].T + other[:3, 3]
    T = estimate.T_target_lidar
    np.testing.assert_allclose(drawn, (expected @ T[:3, :3].T + T[:3, 3])[:, 1:], atol=1e-9)
    assert "1.5 lower" in figure.axes[0].get_title()
    with pytest.raises(InputError, match="no different pose"):
        viz.plot_runner_up(scan, replace(estimate, ambiguity=Ambiguity(np.inf, None)))


def test_a_failed_estimate_has_no_vertices(case):
    scan, estimate = case
    assert set(viz.plot_estimate(scan, replace(estimate, status="failed"))) == {"fit", "edges", "residuals"}


def test_a_cloud_without_rings_has_no_edges_to_draw(case):
    scan, _ = case
    ringless = replace(scan, ring=None)
    figures = viz.plot_estimate(ringless, estimate_pose(ringless, load_target("paper")))
    assert set(figures) == {"fit", "residuals", "vertices"}
    for figure in figures.values():
        assert_legible(figure)
    assert "without rings" in figures["fit"].get_suptitle()


def test_the_published_method_is_drawn_too(case):
    scan, estimate = case
    for figure in viz.plot_estimate(scan, estimate_pose(scan, estimate.target, "paper")).values():
        assert_legible(figure)
