"""A map from above: landmarks as they stand, how well their places are known, trajectories; the graph's structure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import missing_extra
from optshape_graph.mapping.map import Map
from optshape_graph.mapping.track import MappingProblem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#1f5fa8", "#d9660f", "#2a8f4c", "#8c4fb0", "#b5313b")
"""Of trajectories."""

LANDMARK = "#222222"
SIGMAS = 3.0
"""Standard deviations that ellipses enclose in each direction."""


def plot_map(result: Map, magnify: float = 1.0) -> Figure:
    """Draw landmarks, trajectories and ellipses of three standard deviations, seen along -z.

    Args:
        result: the map.
        magnify: how many times the ellipses are drawn too large: where covariances are small.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure, axes = _axes()
    for (name, trajectory), colour in zip(
        result.trajectories.items(), _repeated(len(result.trajectories)), strict=True
    ):
        path = trajectory.poses[:, :3, 3]
        axes.plot(path[:, 0], path[:, 1], "-", color=colour, lw=1.0, label=name or "trajectory")
    for landmark in result.landmarks:
        _outline(axes, landmark.vertices)
        R = landmark.T_world_target[:3, :3]
        place = landmark.T_world_target[:2, 3]
        outline = place + magnify * _ellipse((R @ landmark.covariance[3:, 3:] @ R.T)[:2, :2])
        axes.plot(outline[:, 0], outline[:, 1], color="#b5313b", lw=0.8)
        axes.annotate(landmark.id, tuple(place), textcoords="offset points", xytext=(4, 4), fontsize=7)
    if result.trajectories:
        axes.legend(fontsize=8)
    return figure


def plot_structure(problem: MappingProblem) -> Figure:
    """Draw the factor graph from above: poses, odometry, and a line for every match.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    from matplotlib.collections import LineCollection

    figure, axes = _axes()
    for track, colour in zip(problem.tracks, _repeated(len(problem.tracks)), strict=True):
        path = track.T_world_lidar[:, :2, 3]
        seen = [(path[match.pose], problem.T_world_target[match.landmark][:2, 3]) for match in track.matches]
        moved = [(path[o.i], path[o.j]) for o in track.odometry]
        axes.add_collection(LineCollection(seen, colors="#b5b5b5", linewidths=0.4))
        axes.add_collection(LineCollection(moved, colors=colour, linewidths=1.0))
        axes.plot(path[:, 0], path[:, 1], ".", color=colour, ms=3, label=track.name)
    for name, T in problem.T_world_target.items():
        axes.plot(*T[:2, 3], "s", color=LANDMARK, ms=5)
        axes.annotate(name, tuple(T[:2, 3]), textcoords="offset points", xytext=(4, 4), fontsize=7)
    axes.autoscale_view()
    axes.legend(fontsize=8)
    return figure


def _axes() -> tuple[Figure, Axes]:
    try:
        from matplotlib.figure import Figure
    except ImportError as cause:
        raise missing_extra("matplotlib", "plot", cause) from cause
    figure = Figure(figsize=(8.0, 8.0), layout="constrained")
    axes = figure.subplots()
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    return figure, axes


def _outline(axes: Axes, vertices: Floats) -> None:
    closed = np.vstack([vertices, vertices[:1]])
    axes.plot(closed[:, 0], closed[:, 1], color=LANDMARK, lw=1.5)


def _ellipse(covariance: Floats) -> Floats:
    """(K, 2) outline of SIGMAS standard deviations about the origin."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2 * np.pi, 61)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(SIGMAS * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _repeated(n: int) -> list[str]:
    return [COLOURS[k % len(COLOURS)] for k in range(n)]
