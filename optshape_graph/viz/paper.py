"""The figures of Huang, Clark and Grizzle, "Optimal Target Shape for LiDAR Pose Estimation", drawn again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from optshape_graph.design.judgement import judge
from optshape_graph.design.rings import UniformRings
from optshape_graph.errors import EstimationError
from optshape_graph.pose import estimate_pose
from optshape_graph.se3 import apply, inverse
from optshape_graph.simulation import NoiseModel, random_rings, simulate_target, without_rings
from optshape_graph.simulation.reference import ORIENTATIONS, reference_pose, reference_sensor
from optshape_graph.target import Target
from optshape_graph.viz.design import plot_cells, plot_comparison, plot_convexity, plot_sensitivity
from optshape_graph.viz.pose import plot_fit
from optshape_graph.viz.style import BLUE, GREY, VERMILLION, legend_below, new_figure, outline, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NOISE_FREE = (10.0, 20.0, 30.0, 40.0)
FITTED = (20.0, 24.0, 28.0, 32.0)
PARTIAL = (4.0, 10.0, 22.0, 30.0)
"""Distances of the paper's panels, metres."""

LOST = 0.3
"""Share of the rings that a partly lit target lacks here; the paper does not state it."""


def figures(target: Target, seed: int = 0) -> dict[str, Figure]:
    """Draw the figures that simulation allows, by their numbers in the paper.

    Args:
        target: the paper's.
        seed: of the noise.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    rings = UniformRings()
    return {
        "figure-3-convexity": plot_convexity(),
        "figure-4-6-cells": plot_cells(target, rings),
        "figure-5-sensitivity": plot_sensitivity(target, rings),
        "figure-7-shape": plot_comparison([judge(target)]),
        "figure-8-fit": _one_fit(target, seed),
        "figure-9-noise-free": panels(target, NOISE_FREE, 0, 0.0, seed),
        "figure-13-fitting": panels(target, FITTED, 1, 0.0, seed),
        "figure-14-partial": panels(target, PARTIAL, 1, LOST, seed),
    }


def panels(target: Target, distances: Sequence[float], level: int, lost: float, seed: int) -> Figure:
    """Draw simulated returns and the fitted template at several distances, facing (top) and extreme (bottom).

    Args:
        target: the paper's.
        distances: metres.
        level: of the paper's noise.
        lost: share of the rings that are left out.
        seed: of the noise and of the rings.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure = new_figure(3.0 * len(distances), 6.0)
    axes = figure.subplots(2, len(distances), sharex=True, sharey=True)
    for row, (name, rpy) in enumerate(ORIENTATIONS.items()):
        for column, distance in enumerate(distances):
            panel, rng = plain(axes[row, column], equal=True), np.random.default_rng([seed, row, column])
            truth = reference_pose(target, distance, rpy)
            scan = simulate_target(target, reference_sensor(), truth, noise=NoiseModel.level(level), rng=rng)
            if lost:
                scan = without_rings(scan, random_rings(scan, lost, rng))
            points = apply(inverse(truth), scan.points)
            panel.plot(-points[:, 1], points[:, 2], ".", color=GREY, ms=3, label="returns")
            outline(panel, target.polygon * [-1, 1], BLUE, lw=1.0, label="truth")
            panel.set_title(f"{distance:g} m, {name}: {_fitted(panel, target, scan, truth)}", fontsize=9)
    for panel in axes[-1]:
        panel.set_xlabel("to the right (m)")
    for panel in axes[:, 0]:
        panel.set_ylabel("up (m)")
    legend_below(figure, axes[0, 0], caption="As the LiDAR sees the target, in the true target's frame.")
    return figure


def _fitted(panel, target, scan, truth) -> str:  # type: ignore[no-untyped-def]  # as in `panels`
    """Draw the estimate, and return its status and errors as text."""
    try:
        estimate = estimate_pose(scan, target)
    except EstimationError:
        return "no pose"
    there = apply(inverse(truth) @ target.nearest_equivalent(estimate.T_lidar_target, truth), target.vertices)
    outline(panel, there[:, 1:] * [-1, 1], VERMILLION, ls="--", label="estimate")
    return estimate.status


def _one_fit(target: Target, seed: int) -> Figure:
    rng = np.random.default_rng([seed, 8])
    truth = reference_pose(target, 8.0, ORIENTATIONS["extreme"])
    scan = simulate_target(target, reference_sensor(), truth, noise=NoiseModel.level(1), rng=rng, name="8 m, extreme")
    return plot_fit(scan, estimate_pose(scan, target))
