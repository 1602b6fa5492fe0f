"""A map from above: landmarks as they stand, how well their places are known, trajectories; the graph's structure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optshape_graph.mapping.map import Landmark, Map
from optshape_graph.mapping.track import MappingProblem
from optshape_graph.viz.style import (
    GREY,
    INK,
    VERMILLION,
    colour,
    ellipse,
    legend_below,
    literal,
    magnification,
    new_figure,
    outline,
    plain,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGMAS = 3.0
"""Standard deviations that ellipses enclose in each direction."""

MOST_NAMES = 40
"""Landmarks whose names are written."""


def plot_map(result: Map, magnify: float | None = None) -> Figure:
    """Draw landmarks, trajectories and ellipses of three standard deviations, seen along -z.

    Args:
        result: the map.
        magnify: how many times the ellipses are drawn too large; None: as many as makes them visible.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure, axes = _axes()
    for k, (name, trajectory) in enumerate(result.trajectories.items()):
        path = trajectory.poses[:, :3, 3]
        axes.plot(path[:, 0], path[:, 1], "-", color=colour(k), lw=1.2, label=f"trajectory {literal(name)}".strip())
        axes.plot(path[0, 0], path[0, 1], "o", color=colour(k), ms=5, label=None if k else "start")
    drawn = [*(t.poses[:, :2, 3] for t in result.trajectories.values()), *(m.vertices[:, :2] for m in result.landmarks)]
    extent = float(np.ptp(np.vstack(drawn), axis=0).max()) if drawn else 1.0
    covariances = [_from_above(landmark) for landmark in result.landmarks]
    if magnify is None:
        sizes = [SIGMAS * np.sqrt(max(np.linalg.eigvalsh(C)[-1], 0.0)) for C in covariances]
        magnify = magnification(sizes, 0.5 * extent)
    for landmark, C in zip(result.landmarks, covariances, strict=True):
        outline(axes, landmark.vertices[:, :2])
        place = landmark.T_world_target[:2, 3]
        loop = place + magnify * ellipse(C, SIGMAS)
        axes.plot(loop[:, 0], loop[:, 1], color=VERMILLION, lw=1.0)
        if len(result.landmarks) <= MOST_NAMES:
            axes.annotate(literal(landmark.id), tuple(place), textcoords="offset points", xytext=(8, 8))
    large = "" if magnify == 1 else f", drawn {magnify:g} times too large"
    axes.set_title(f"{len(result.landmarks)} landmarks; ellipses of {SIGMAS:g} standard deviations{large}")
    if result.trajectories:
        legend_below(figure)
    return figure


def plot_structure(problem: MappingProblem) -> Figure:
    """Draw the factor graph of a map from above: poses, odometry, and a line for every match.

    `viz.graph.plot_graph` draws any GTSAM graph.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure, axes = _axes()
    from matplotlib.collections import LineCollection

    for k, track in enumerate(problem.tracks):
        path = track.T_world_lidar[:, :2, 3]
        seen = [(path[match.pose], problem.T_world_target[match.landmark][:2, 3]) for match in track.matches]
        moved = [(path[o.i], path[o.j]) for o in track.odometry]
        label = f"{len(seen)} matches" if k == 0 else None
        axes.add_collection(LineCollection(seen, colors=GREY, linewidths=0.5, label=label, zorder=1))
        axes.add_collection(LineCollection(moved, colors=colour(k), linewidths=1.2, zorder=2))
        axes.plot(
            path[:, 0], path[:, 1], ".", color=colour(k), ms=4, label=f"{len(path)} poses of {literal(track.name)}"
        )
    for name, T in problem.T_world_target.items():
        axes.plot(*T[:2, 3], "s", color=INK, ms=6, zorder=3)
        if len(problem.T_world_target) <= MOST_NAMES:
            axes.annotate(literal(name), tuple(T[:2, 3]), textcoords="offset points", xytext=(8, 6))
    axes.autoscale_view()
    axes.set_title(f"factor graph: {len(problem.T_world_target)} landmarks (squares), lines from where they were seen")
    legend_below(figure)
    return figure


def _axes() -> tuple[Figure, Axes]:
    figure = new_figure(8.0, 8.0)
    axes = plain(figure.subplots())
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x of the world (m)", ylabel="y of the world (m)")
    return figure, axes


def _from_above(landmark: Landmark) -> np.ndarray:
    """(2, 2) covariance of the place, seen along the world's -z."""
    R = landmark.T_world_target[:3, :3]
    return np.asarray((R @ landmark.covariance[3:, 3:] @ R.T)[:2, :2])
